"""Claim: {x : |x - x₀(t)|²_{P(t)} ≤ ρ(t)} is a funnel of ẋ = f(t, x, u, w) for every t and every w.

With x̄ = x - x₀ = Tz on a piece of time, s in [0, 1] along its interval of length h, the proof is
    c(s,z) = dρ/ds - dW/ds + μ(s,z)(ρ(s) - W(s,z)) > 0 for every s in [0, 1] and every z,
W = x̄'Px̄ and dW/ds = 2x̄'P(hf - dx₀/ds) + x̄'(dP/ds)x̄ along the closed loop: so Ẇ < ρ̇ wherever
W = ρ, thesis (5.5), Lemma 5.2. In Bernstein form c = Σ_k c_k(z) s^k (1-s)^(N-k), and it is enough
that every c_k = v'Q_k v with Q_k ≻ 0. The file states μ and Q at both ends of each piece; in
between μ is linear and Q_k is found here, by least-norm correction of the interpolated one.
Pieces have to cover every interval, for every vertex of the box of w (f is affine in each entry)
and every mode of a policy with limits (see `saturation`).
"""

from collections.abc import Mapping
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, IntArray, Json
from nlsid_core.certificate import containment
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.funnel_pieces import Pieces, decide_pieces
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.verdict import Decision
from nlsid_core.continuous.funnel import Funnel
from nlsid_core.continuous.policy import Policy
from nlsid_core.continuous.vector_field import VectorField
from nlsid_core.errors import CertificateMismatch, CertificateRejected, Undecided

KIND = "trajectory_funnel"
# Larger ones would take this checker hours, and so would a denial of service.
MAX_STATES, MAX_FIELD_DEGREE, MAX_BASIS_DEGREE = 16, 7, 3
ABOUT = ("vector_field", "policy", "funnel")


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide that the bound funnel is one for its dynamics and policy, and ends in the goal."""
    if set(about) != set(ABOUT):
        raise CertificateRejected(f"a {KIND} claim is about {', '.join(ABOUT)}")
    data.only(claim, {"kind", "about", "goal"}, source="claim")
    data.only(proof, {"goal_multiplier", "basis", "pieces", "kappa"}, source="proof")
    field = VectorField.from_document(about["vector_field"], source="vector field")
    policy = Policy.from_document(about["policy"], source="policy")
    funnel = Funnel.from_document(about["funnel"], source="funnel")
    degree = max(int(np.max(p.exponents.sum(axis=1), initial=0)) for e in field.pieces for p in e)
    if field.n > MAX_STATES or degree > MAX_FIELD_DEGREE:
        raise Undecided(
            f"dynamics with {field.n} states and degree {degree}: this checker decides up to "
            f"{MAX_STATES} and {MAX_FIELD_DEGREE}"
        )
    _refuse_strangers(about, field, policy, funnel)
    for k, P in enumerate(funnel.P):
        if not containment.is_positive_definite(P):
            raise CertificateRejected(f"P is not positive definite at knot {k}")
    goal_text = ""
    if "goal" in claim:
        goal = _json.member(claim, "goal", dict, source="claim")
        data.only(goal, {"centre", "P"}, source="claim goal")
        refuse_goal(
            funnel,
            _json.array(goal, "centre", (field.n,), source="goal"),
            _json.array(goal, "P", (field.n, field.n), source="goal"),
            _json.number(proof, "goal_multiplier", source="proof"),
        )
        goal_text = ", and ends in the goal"
    refuse_invalid(field, policy, funnel)
    pieces = read_pieces(proof, field.n, len(policy.limits))
    if pieces.kappa is not None:
        refuse_kappa(pieces.kappa, field)
    refuse_gaps(pieces, field, funnel, policy.modes())
    margin = decide_pieces(field, policy, funnel, pieces, mode)
    names = field.names[1:]
    if len(field.pieces) > 1 and len(field.valid):
        valid_text = ", x and u within the bounds `valid` of each time span"
    else:
        valid_text = "".join(
            f", {names[j]} within [{low:g}, {high:g}]" for j, low, high in field.validity(0)
        )
    clipped = "".join(
        f", {names[field.n + int(i)]} clipped to [{low:g}, {high:g}]"
        for i, low, high in policy.limits.tolist()
    )
    bounds = ", ".join(
        f"w{j} in [{low:g}, {high:g}]" for j, (low, high) in enumerate(field.uncertain)
    )
    unlimited = " and without other saturation" if clipped else " and without saturation"
    limited = set(policy.limits[:, 0].astype(int).tolist()).union(
        set.intersection(
            *({j - field.n for j, *_ in field.validity(i)} for i in range(len(field.pieces)))
        )
    )
    return Decision(
        statement=(
            f"funnel: every solution in it at a time in [{funnel.t0:g}, {funnel.tf:g}] s stays in "
            f"it for all later times{goal_text}{valid_text}; {len(pieces)} pieces of time, "
            f"V decreases on the boundary by at least the margin, in 1/s,"
        ),
        margin=margin,
        assumptions=(
            "the state obeys the stored dynamics with the stored policy, applied continuously"
            + clipped
            + ("" if set(range(field.m)) <= limited else unlimited),
            *((f"at every time {bounds}",) if bounds else ()),
        ),
    )


def refuse_goal(funnel: Funnel, centre: FloatArray, P: FloatArray, multiplier: float) -> None:
    """Raise CertificateRejected unless the funnel's end lies in {|x - centre|²_P ≤ 1}, exactly."""
    rho = Fraction(float(funnel.rho[-1]))
    inner = [[Fraction(float(e)) / rho for e in row] for row in funnel.P[-1].tolist()]
    if not containment.ellipsoid_inside(
        funnel.x.ends()[-1].tolist(), inner, centre.tolist(), P.tolist(), multiplier
    ):
        raise CertificateRejected("the funnel does not end in the goal ellipsoid")


def read_pieces(proof: Json, n: int, limited: int) -> Pieces:
    """The pieces of a proof as arrays; DocumentError if they are not what they should be.

    limited: how many inputs have limits.
    """
    basis = _json.array(proof, "basis", (None, n), source="proof")
    small = (basis >= 0).all() and (basis.sum(axis=1) <= MAX_BASIS_DEGREE).all()
    if not (small and (basis == np.round(basis)).all()):
        raise CertificateRejected("the Gram basis should hold small nonnegative exponents")
    exponents = basis.astype(np.int64)
    if len(np.unique(exponents, axis=0)) != len(exponents) or len(exponents) > 500:
        raise CertificateRejected("the Gram basis should hold at most 500 distinct monomials")
    if not (exponents == 0).all(axis=1).any():
        raise CertificateRejected("the Gram basis needs 1, so that c is positive everywhere")
    entries = _json.member(proof, "pieces", list, source="proof")
    if not entries:
        raise CertificateRejected("the proof has no pieces")
    size = len(exponents) * (len(exponents) + 1) // 2
    terms = Pieces.multiplier_size(exponents)
    whole: dict[str, list[int]] = {key: [] for key in ("interval", "vertex", "level", "index")}
    T, mu, gram, mode, tau = [], [], [], [], []
    sides = (n + 1) * (n + 2) // 2
    keys = {*whole, "T", "mu", "gram"} | ({"mode", "tau"} if limited else set())
    for number, entry in enumerate(entries):
        source = f"piece {number}"
        if not isinstance(entry, dict):
            raise CertificateRejected(f"{source} should be an object")
        data.only(entry, keys, source=source)
        for key, values in whole.items():
            values.append(_json.member(entry, key, int, source=source))
        T.append(_json.array(entry, "T", (n, n), source=source))
        mu.append(_json.array(entry, "mu", (2, terms), source=source))
        gram.append(_json.array(entry, "gram", (2, size), source=source))
        if limited:
            mode.append(_json.array(entry, "mode", (limited,), source=source))
            tau.append(_json.array(entry, "tau", (2, limited, sides), source=source))
    columns = {key: np.array(values, dtype=np.int64) for key, values in whole.items()}
    kappa = _json.array(proof, "kappa", (None,), source="proof") if "kappa" in proof else None
    modes = np.array(mode).reshape(len(entries), limited)
    if not np.isin(modes, (-1, 0, 1)).all():
        raise CertificateRejected("a mode should be -1 (low), 0 (free) or 1 (high) per limit")
    return Pieces(
        exponents,
        **columns,
        T=np.array(T),
        mu=np.array(mu),
        gram=np.array(gram),
        mode=modes.astype(np.int64),
        tau=np.array(tau).reshape(len(entries), 2, limited, sides),
        kappa=kappa,
    )


def refuse_kappa(kappa: FloatArray, field: VectorField) -> None:
    """Raise CertificateRejected unless w only pushes and each κ is a power of two."""
    if any(field.pushes(span) is None for span in range(len(field.pieces))):
        raise CertificateRejected("w does more than add constants: kappa does not bound it")
    if len(kappa) != len(field.uncertain) or not (np.frexp(kappa)[0] == 0.5).all():
        raise CertificateRejected("kappa should hold one power of two for every w")
    if np.abs(np.log2(kappa)).max(initial=0.0) > 100:
        raise CertificateRejected("kappa is out of range")


def refuse_invalid(field: VectorField, policy: Policy, funnel: Funnel) -> None:
    """Raise CertificateRejected unless x and u stay where the dynamics are valid, exactly.

    |g'x̄| ≤ d wherever W ≤ ρ if d²P - ρgg' ⪰ 0, which holds between knots if it does at them.
    Centres and gains between knots are convex combinations of their control points. An input with
    limits inside those bounds stays there by itself.
    """
    clipped = {int(i) + field.n: (low, high) for i, low, high in policy.limits.tolist()}
    for k in range(len(funnel.t) - 1):
        for entry, low, high in field.validity(field.span(float(funnel.t[k]))):
            if entry in clipped and low <= clipped[entry][0] and clipped[entry][1] <= high:
                continue
            centre, rows = policy.entry(entry, k)
            middle = [Fraction(c) for c in centre.tolist()]
            room = min(Fraction(high) - max(middle), min(middle) - Fraction(low))
            for row in rows.tolist():
                g = [Fraction(e) for e in row]
                for knot in (k, k + 1):
                    rho = Fraction(float(funnel.rho[knot]))
                    slack = [
                        [room**2 * Fraction(p) - rho * a * b for p, b in zip(line, g, strict=True)]
                        for line, a in zip(funnel.P[knot].tolist(), g, strict=True)
                    ]
                    if room <= 0 or not containment.is_positive_semidefinite(slack):
                        raise CertificateRejected(
                            f"the funnel leaves where its dynamics are valid: entry {entry} of "
                            f"(x, u) is not within [{low:g}, {high:g}] at {funnel.t[knot]:g} s"
                        )


def refuse_gaps(pieces: Pieces, field: VectorField, funnel: Funnel, modes: IntArray) -> None:
    """Raise CertificateRejected unless the pieces cover all time, every vertex of w, every mode."""
    intervals = len(funnel.t) - 1
    vertices = len(field.vertices()) if pieces.kappa is None else 1
    missing = np.setdiff1d(field.breaks[(field.breaks > funnel.t0) & (field.breaks < funnel.tf)],
                           funnel.t)  # fmt: skip
    if len(missing):
        raise CertificateRejected(f"the dynamics change at {missing[0]:g} s, which is no knot")
    covered: dict[tuple[int, int, tuple[int, ...]], Fraction] = {}
    table = zip(pieces.interval.tolist(), pieces.vertex.tolist(), map(tuple, pieces.mode.tolist()),
                pieces.level.tolist(), pieces.index.tolist(), strict=True)  # fmt: skip
    for k, v, mode, level, index in sorted(
        table, key=lambda e: (*e[:3], Fraction(e[4], 2 ** min(e[3], 16)))
    ):
        if not (0 <= k < intervals and 0 <= v < vertices):
            raise CertificateRejected(f"a piece is about interval {k}, vertex {v}, which is none")
        if not (0 <= level <= 16 and 0 <= index < 2**level):
            raise CertificateRejected(f"part {index} of 2^{level} is none of an interval's parts")
        start, end = covered.get((k, v, mode), Fraction(0)), Fraction(index + 1, 2**level)
        if Fraction(index, 2**level) > start:
            raise CertificateRejected(
                f"a piece is missing in interval {k} (vertex {v}, mode {mode}): from s = {start}"
            )
        covered[k, v, mode] = max(start, end)
    for k, v, mode in product(range(intervals), range(vertices), map(tuple, modes.tolist())):
        if covered.get((k, v, mode), Fraction(0)) < 1:
            raise CertificateRejected(
                f"a piece is missing: interval {k} from {funnel.t[k]:g} to {funnel.t[k + 1]:g} s "
                f"(vertex {v}, mode {mode}) is not covered"
            )


def _refuse_strangers(
    about: Mapping[str, Json], field: VectorField, policy: Policy, funnel: Funnel
) -> None:
    digests = {role: _json.digest(content) for role, content in about.items()}
    for owner, role, stated in (
        ("policy", "vector_field", policy.vector_field),
        ("funnel", "vector_field", funnel.vector_field),
        ("funnel", "policy", funnel.policy),
    ):
        if stated != digests[role]:
            raise CertificateMismatch(f"the {owner} was made for another {role}: {stated[:23]}...")
    if not (
        funnel.n == field.n == policy.x.control.shape[2] and policy.u.control.shape[2] == field.m
    ):
        raise CertificateRejected("dynamics, policy and funnel differ in size")
    same = np.array_equal(funnel.t, policy.t) and np.array_equal(funnel.x.control, policy.x.control)
    if not same:
        raise CertificateRejected("the funnel is around another nominal than the policy's")


def document_pieces(pieces: Pieces) -> list[Any]:
    """The pieces as JSON, read back by `read_pieces`."""
    limited = pieces.mode.shape[1] > 0
    return [
        {
            "interval": int(pieces.interval[i]),
            "vertex": int(pieces.vertex[i]),
            "level": int(pieces.level[i]),
            "index": int(pieces.index[i]),
            "T": pieces.T[i].tolist(),
            "mu": pieces.mu[i].tolist(),
            "gram": pieces.gram[i].tolist(),
        }
        | ({"mode": pieces.mode[i].tolist(), "tau": pieces.tau[i].tolist()} if limited else {})
        for i in range(len(pieces))
    ]
