"""Claim: solutions of ẋ = f(x) that start in {V ≤ level} stay there and tend to the origin.

Proof: V = v'Pv and -V̇ - σ·(level - V) = w'Qw with P ≻ 0, Q ≻ 0, σ = u'Su, S ⪰ 0, where v and w
vanish at x = 0 only (no constant, a pure power of each variable). Then V ≥ λ_min(P)|v|² > 0 is
radially unbounded, so {V ≤ level} is compact, and V̇ < 0 on it except at the origin (LaSalle).
Without a level: σ = 0, and the origin attracts every solution.
Source: Lyapunov's theorem; Parrilo 2000, Section 7.3.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate.identity import (
    Mode,
    Product,
    decide_gram,
    decide_identity,
    one,
    vanishes_only_at_zero,
)
from nlsid_core.certificate.verdict import Decision
from nlsid_core.errors import CertificateRejected
from nlsid_core.polynomial import Gram, Polynomial


def prove_attraction(
    field: Sequence[Polynomial],
    V: Polynomial,
    level: float | Fraction | None,
    *,
    positive: Gram,
    decrease: Gram,
    multiplier: Gram | None = None,
    mode: Mode = "exact",
) -> float:
    """Prove that {V ≤ level} (everything, if level is None) is attracted by the origin.

    field: ẋ_j, in the order of the variables. positive, decrease, multiplier: P, Q, S above.
    Returns the margin; raises CertificateRejected with the reason, Undecided if this mode cannot
    tell.
    """
    names = V.names
    if len(field) != len(names) or any(f.names != names for f in field):
        raise CertificateRejected(f"{len(field)} equations for the variables {', '.join(names)}")
    if any(f.coefficient([0] * len(names)) for f in field):
        raise CertificateRejected("the origin is not an equilibrium: f(0) is not zero")
    if level is not None and level <= 0:
        raise CertificateRejected(f"level is {float(level):g}, should be positive")
    if (level is None) != (multiplier is None):
        raise CertificateRejected("a level needs a multiplier, and a multiplier needs a level")
    for gram, what in ((positive, "V"), (decrease, "-V̇")):
        if not vanishes_only_at_zero(gram):
            raise CertificateRejected(f"the basis of {what} does not vanish at the origin only")
    unit = one(names)
    shape = decide_identity([Product(unit, V)], positive, strict=True, mode=mode)
    target = [Product(V, f, sign=-1, derivative=j) for j, f in enumerate(field)]
    if multiplier is not None and level is not None:
        decide_gram(multiplier, strict=False, mode=mode)
        target += [Product(multiplier, one(names, level), sign=-1), Product(multiplier, V)]
    return min(shape, decide_identity(target, decrease, strict=True, mode=mode))


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide `{V ≤ level}` for the `field` written in the claim."""
    if about:
        raise CertificateRejected(f"this claim is about no file; it names {', '.join(about)}")
    data.only(claim, {"kind", "about", "variables", "field", "V", "level"}, source="claim")
    data.only(proof, {"positive", "decrease", "multiplier"}, source="proof")
    names = data.read_names(claim, source="claim")
    field = [
        data.read_polynomial(entry, names, source=f"field {j}")
        for j, entry in enumerate(_json.member(claim, "field", list, source="claim"))
    ]
    V = data.read_polynomial(_json.member(claim, "V", dict, source="claim"), names, source="V")
    stated = claim.get("level")
    level = None if stated is None else data.read_number(stated, source="level")
    grams = {
        key: data.read_gram(entry, names, source=key)
        for key, entry in proof.items()
        if entry is not None
    }
    if not {"positive", "decrease"} <= set(grams):
        raise CertificateRejected("the proof needs the Gram matrices 'positive' and 'decrease'")
    margin = prove_attraction(
        field,
        V,
        level,
        positive=grams["positive"],
        decrease=grams["decrease"],
        multiplier=grams.get("multiplier"),
        mode=mode,
    )
    where = "every solution" if level is None else f"every solution from {{{V} <= {level}}}"
    dynamics = ", ".join(f"d{name}/dt = {f}" for name, f in zip(names, field, strict=True))
    return Decision(
        statement=f"region of attraction: {where} of {dynamics} tends to the origin,",
        margin=margin,
    )
