"""Claim `falsification` decided a second time, written from its page alone, in Fractions.

Nothing is rounded: observers are run from the state 0 and from every unit vector, and the form is
made of their innovations by polarisation. The tube's own proof is decided by its own oracle.
"""

from collections.abc import Mapping
from fractions import Fraction
from math import prod
from typing import Any

from nlsid_core import files
from tests.core.kernel import oracle_tube
from tests.core.kernel.oracle_stability import Json, Rows, exact, is_definite, solved

Vector = list[Fraction]


def agrees(document: Json, about: Mapping[str, Json]) -> bool:
    """Whether the samples of a proof document break the tube's assumption from every state."""
    try:
        return is_falsified(document["claim"], document["proof"], about)
    except (ArithmeticError, AssertionError, LookupError, StopIteration, TypeError, ValueError):
        return False


def is_falsified(claim: Json, proof: Json, about: Mapping[str, Json]) -> bool:
    """What the page asks, of documents that are what they should be."""
    binding = claim["about"]["tube"]
    tube_proof = about[binding["file"]]
    if binding["digest"] != files.digest(tube_proof) or tube_proof["claim"]["kind"] != "tube":
        return False
    if not oracle_tube.agrees(tube_proof, about):
        return False
    model, funnel = (
        about[tube_proof["claim"]["about"][role]["file"]] for role in ("model", "funnel")
    )
    assert claim["tube"] >= 1
    tube = funnel["tubes"][claim["tube"] - 1]
    if tube["assumption"]["kind"] != "fading":
        return False
    energy, peak = ([exact(entry) for entry in proof[key]] for key in ("energy", "peak"))
    run, first, u, y = samples_of(claim, model)
    assert len(energy) == len(peak) == len(y)
    if min(energy + peak) < 0 or (any(peak) and "peak" not in tube):
        return False
    g = levels(tube["follows"], u)[first - run :] if "follows" in tube else [Fraction(1)] * len(y)
    level, rho = exact(tube["level"]), exact(tube["rho"])
    single = exact(tube["peak"]["level"]) if "peak" in tube else Fraction(0)
    most = sum((w * level * now for w, now in zip(energy, g, strict=True)), Fraction(0))
    most += sum(
        (w * single * max(now, Fraction(1)) for w, now in zip(peak, g, strict=True)), Fraction(0)
    )
    n = len(tube["P"])
    units = [[Fraction(int(i == j)) for i in range(n)] for j in range(n)]
    runs = [innovations(model, tube, u, y, run, first, x) for x in ([Fraction(0)] * n, *units)]
    # e_k of v = [x; 1]: column j is what the unit vector j adds, the last that of the state 0.
    R = [[exact(entry) for entry in row] for row in tube["R"]]
    form = [[Fraction(0)] * (n + 1) for _ in range(n + 1)]
    for k in range(len(y)):
        weight = peak[k] + sum((energy[j] * rho ** (j - k) for j in range(k, len(y))), Fraction(0))
        base = runs[0][k]
        columns = [[b - a for a, b in zip(base, one[k], strict=True)] for one in runs[1:]]
        columns.append(base)
        for i in range(n + 1):
            for j in range(n + 1):
                form[i][j] += weight * bilinear(columns[i], R, columns[j])
    form[n][n] -= most
    return most > 0 and is_definite(form)


def samples_of(claim: Json, model: Json) -> tuple[int, int, list[Vector], list[Vector]]:
    """run, first, u and y of a claim."""
    run, first = claim["run"], claim["first"]
    assert type(run) is int
    assert type(first) is int
    assert 0 <= run <= first
    u, y = ([[exact(entry) for entry in row] for row in claim[key]] for key in "uy")
    several = isinstance(model["u"], list)
    assert all(len(row) == (len(model["u"]) if several else 1) for row in u)
    assert all(len(row) == (len(model["y"]) if isinstance(model["y"], list) else 1) for row in y)
    assert y
    assert len(u) == first - run + len(y)
    return run, first, u, y


def innovations(
    model: Json, tube: Json, u: list[Vector], y: list[Vector], run: int, first: int, x: Vector
) -> list[Vector]:
    """e of the observer that is at x at the window's first sample."""
    L = [[exact(entry) for entry in row] for row in tube["L"]]
    found = []
    for k, measured in enumerate(y, first - run):
        predicted, x = step(model, x, u, k)
        e = [a - b for a, b in zip(measured, predicted, strict=True)]
        x = [
            entry + sum((gain * part for gain, part in zip(row, e, strict=True)), Fraction(0))
            for entry, row in zip(x, L, strict=True)
        ]
        found.append(e)
    return found


def step(model: Json, x: Vector, u: list[Vector], k: int) -> tuple[Vector, Vector]:
    """ŷ and f at sample k of u."""
    if model["kind"] == "difference_equation":
        a, b = ([exact(entry) for entry in model[key]] for key in "ab")
        now = u[k][0]
        out = x[0] + b[0] * now + exact(model["c"])
        later = [*x[1:], Fraction(0)]
        return [out], [a[i] * out + b[i + 1] * now + later[i] for i in range(len(a))]
    assert model["kind"] == "state_affine"
    w = []
    for i, delay in model["window"]:
        assert k - delay >= 0
        low, high = (exact(end) for end in model["u_range"][i])
        value = u[k - delay][i]
        if model["on_out_of_range"] == "refuse":
            assert low <= value <= high
        value = low if value < low else high if value > high else value
        w.append((value - exact(model["u_offset"][i])) / exact(model["u_scale"][i]))
    p = len(model["y"])
    lead, *lags = [evaluated(part, w) for part in model["G"]]
    right = [row[0] for row in evaluated(model["p"], w)]
    for j, G in enumerate(lags):
        for i in range(p):
            right[i] += sum((G[i][s] * x[j * p + s] for s in range(p)), Fraction(0))
    y_bar = [row[0] for row in solved(lead, [[-entry] for entry in right])]
    pairs = zip(y_bar, model["y_scale"], model["y_offset"], strict=True)
    return [v * exact(scale) + exact(offset) for v, scale, offset in pairs], (y_bar + x)[: len(x)]


def evaluated(part: Json, w: Vector) -> Rows:
    """A matrix polynomial at w; a vector as a column."""
    total: Any = None
    for powers, coefficient in zip(part["exponents"], part["coefficients"], strict=True):
        assert sum(powers) <= 20
        size = prod((v**power for v, power in zip(w, powers, strict=True)), start=Fraction(1))
        rows = [entry if isinstance(entry, list) else [entry] for entry in coefficient]
        term = [[size * exact(entry) for entry in row] for row in rows]
        total = term if total is None else [
            [a + b for a, b in zip(x, y, strict=True)] for x, y in zip(total, term, strict=True)
        ]  # fmt: skip
    found: Rows = total
    return found


def levels(follows: Json, u: list[Vector]) -> list[Fraction]:
    """g at every sample of a run with these inputs."""
    found = []
    for k in range(len(u)):
        total = Fraction(0)
        for term, weight in zip(follows["terms"], follows["weights"][0], strict=True):
            scale, fading = exact(term["scale"]), exact(term["fading"])
            driven = [
                prod((row[i] for i in term["inputs"]), start=Fraction(1)) for row in u[: k + 1]
            ]
            for age in range(k + 1):
                at = k - age
                if term["of"] == "change":
                    v = (driven[at] - driven[at - 1]) / scale if at else Fraction(0)
                else:
                    v = (driven[at] - exact(term["centre"])) / scale
                total += exact(weight) * fading**age * v**2
        found.append(total)
    return found


def bilinear(a: Vector, R: Rows, b: Vector) -> Fraction:
    return sum((x * R[i][j] * z for i, x in enumerate(a) for j, z in enumerate(b)), Fraction(0))
