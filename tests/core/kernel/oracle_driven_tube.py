"""Claim `tube` about a policy decided a second time, in Fractions.

Written from docs/certificate_driven_tube.md alone. Definiteness is decided by LDL' (as in the
other oracle, which shares nothing with the kernel), and `runs` plays exact runs of the observer, to
hold a claim against what it says.
"""

import random
from collections.abc import Iterator, Mapping
from fractions import Fraction

from nlsid_core import files
from tests.core.kernel.oracle_stability import Json, Rows, is_definite


def rows(values: list[list[float]]) -> Rows:
    return [[Fraction(entry) for entry in row] for row in values]


def parts(model: Json) -> tuple[Rows, list[Fraction], list[Fraction], Fraction, Fraction]:
    """A, B, f, D, c."""
    a, b = ([Fraction(entry) for entry in model[key]] for key in "ab")
    c, n = Fraction(model["c"]), len(model["a"])
    A = [[a[i] if j == 0 else Fraction(int(j == i + 1)) for j in range(n)] for i in range(n)]
    return A, [b[i + 1] + a[i] * b[0] for i in range(n)], [entry * c for entry in a], b[0], c


def closed(model: Json, policy: Json, kappa: Fraction) -> tuple[Rows, list[Fraction]]:
    """A - κBK and C - κDK."""
    A, B, _, D, _ = parts(model)
    K = [Fraction(entry) for entry in policy["K"][0]]
    n = len(A)
    F = [[A[i][j] - kappa * B[i] * K[j] for j in range(n)] for i in range(n)]
    return F, [Fraction(int(j == 0)) - kappa * D * K[j] for j in range(n)]


def is_proved(documents: Json, slack: float) -> bool:
    """Whether every obligation holds, for the documents by role."""
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    P, R = rows(funnel["P"]), rows(funnel["R"])
    n, rho, kept = len(P), Fraction(funnel["rho"]), 1 - Fraction(slack)
    tau, width = Fraction(funnel["tau"][0]), Fraction(funnel["half_widths"][0])
    level, inlet = Fraction(funnel["level"]), Fraction(funnel["inlet"])
    given = funnel["assumption"]
    budget, measured = Fraction(given["budget"]), Fraction(given["measured"])
    factor, samples = Fraction(given["safety_factor"]), given["samples"]
    low, high = (Fraction(end) for end in model["u_range"])
    u, x = [Fraction(entry[0]) for entry in policy["u"]], rows(policy["x"])
    if not (0 < kept < 1 and is_definite(P) and is_definite(R) and 0 < rho <= 1):
        return False
    if (given["kind"] == "energy") != (rho == 1) or tau <= 0 or width <= 0:
        return False
    L = [Fraction(entry[0]) for entry in policy["L"]]
    for kappa in (Fraction(0), Fraction(1)):
        F, output = closed(model, policy, kappa)
        wide = [[*F[i], L[i]] for i in range(n)]
        supply = [[rho * entry for entry in row] + [Fraction(0)] for row in P]
        supply.append([Fraction(0)] * n + [R[0][0]])
        size = range(n + 1)
        columns = [[row[i] for row in wide] for i in size]
        growth = [[kept * supply[i][j] - between(columns[i], P, columns[j]) for j in size]
                  for i in size]  # fmt: skip
        h = [*output, Fraction(1)]
        bound = [[supply[i][j] - tau * h[i] * h[j] for j in size] for i in size]
        if not (is_definite(growth) and is_definite(bound)):
            return False
    if level > tau * width**2 or Fraction(policy["period"]) != Fraction(model["period"]):
        return False
    if any(not low <= entry <= high for entry in u) or not 1 <= samples <= len(u):
        return False
    if min(inlet, budget, measured) < 0 or factor < 1 or budget < factor**2 * measured:
        return False
    if not given["measured_on"] or any(
        overlap(span(a["digest"]), span(b["digest"]))
        for a in given["measured_on"]
        for b in given["designed_on"]
    ):
        return False
    A, B, f, _, _ = parts(model)
    q = Fraction(0)
    for k in range(len(u) - 1):
        d = [
            sum((A[i][j] * x[k][j] for j in range(n)), B[i] * u[k] + f[i]) - x[k + 1][i]
            for i in range(n)
        ]
        q += len(u) * V(P, d)
    s = inlet + budget
    return level - s - q >= 0 and (level - s - q) ** 2 >= 4 * s * q


def span(digest: str) -> tuple[str, float, float]:
    """The recording of a trial, its first sample and the one after its last."""
    recording, _, window = digest.partition("[")
    if "[" not in digest:
        return recording, 0, float("inf")
    first, end = window.removesuffix("]").split(":")
    if not window.endswith("]") or not int(first) < int(end) < 10**12:
        raise ValueError(digest)
    return recording, int(first), int(end)


def overlap(a: tuple[str, float, float], b: tuple[str, float, float]) -> bool:
    return a[0] == b[0] and max(a[1], b[1]) < min(a[2], b[2])


def between(left: list[Fraction], P: Rows, right: list[Fraction]) -> Fraction:
    """left'P right."""
    n = range(len(P))
    return sum((left[i] * P[i][j] * right[j] for i in n for j in n), Fraction(0))


def V(P: Rows, x: list[Fraction]) -> Fraction:
    return between(x, P, x)


def runs(documents: Json, rng: random.Random, samples: int) -> Iterator[tuple[Fraction, Fraction]]:
    """(o, E) of an exact run with random start in the inlet, innovations, and κ at every sample."""
    model, policy, funnel = (documents[role] for role in ("model", "policy", "funnel"))
    P, rho = rows(funnel["P"]), Fraction(funnel["rho"])
    n, R = len(P), Fraction(funnel["R"][0][0])
    inlet, budget = Fraction(funnel["inlet"]), Fraction(funnel["assumption"]["budget"])
    L = [Fraction(entry[0]) for entry in policy["L"]]
    x = [Fraction(rng.randrange(-8, 9)) for _ in range(n)]
    while inlet and V(P, x) > inlet:
        x = [entry / 2 for entry in x]
    if not inlet:
        x = [Fraction(0)] * n
    E = Fraction(0)
    for _ in range(samples):
        e = Fraction(rng.randrange(-8, 9), 4)
        for _ in range(60):
            if rho * E + R * e * e > budget:
                e /= 2
        if rho * E + R * e * e > budget:
            e = Fraction(0)
        E = rho * E + R * e * e
        F, output = closed(model, policy, Fraction(rng.randrange(5), 4))
        yield sum((h * entry for h, entry in zip(output, x, strict=True)), e), E
        x = [sum((F[i][j] * x[j] for j in range(n)), L[i] * e) for i in range(n)]
        x = [entry.limit_denominator(10**12) for entry in x]


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether a proof document about these files proves its claim."""
    try:
        bindings = document["claim"]["about"]
        documents = {role: about[bindings[role]["file"]] for role in ("model", "policy", "funnel")}
        policy, funnel = documents["policy"], documents["funnel"]
        digest = {role: files.digest(entry) for role, entry in documents.items()}
        if policy["model"] != digest["model"] or funnel["model"] != digest["model"]:
            return False
        return funnel["policy"] == digest["policy"] and is_proved(
            documents, document["proof"]["slack"]
        )
    except (ArithmeticError, LookupError, TypeError, ValueError):
        return False
