"""Lemmas 5.2 and 5.3 of the thesis for any polynomial V, in t, x and whatever else is bounded.

Both are one polynomial inequality on a domain, decided exactly by the checker. For funnels along
trajectories `design_funnel` is the way: it needs no t in any program.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from nlsid_core.arrays import Json
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.polynomial import Polynomial
from nlsid_core.sos.search import lower_bound


@dataclass(frozen=True)
class Lemma:
    """What was proved: -V̇ ≥ margin on V = 1, or λ(σ - V) - V̇ ≥ margin on σ ≤ V ≤ 1, by `proof`."""

    margin: float
    proof: Json


def lemma_invariance(
    V: Polynomial,
    field: Sequence[Polynomial],
    states: Sequence[str],
    *,
    domain: Sequence[Polynomial] = (),
    degree: int | None = None,
) -> Lemma:
    """Lemma 5.2: V̇ < 0 wherever V = 1 (on the domain), so {V ≤ 1} is a funnel if it is bounded.

    V, field: in the same variables; `states` are those with a rate, in the order of `field`, and t,
    if it occurs, has rate 1. domain: polynomials ≥ 0 that bound t and what is uncertain.
    Raises Infeasible if no positive margin is proved: with V̇ ≤ 0 alone the lemma is false.
    """
    rate = derivative(V, field, states)
    found = lower_bound(-rate, domain=domain, equalities=[(V - 1).over(rate.names)], degree=degree)
    return _positive(found.value, found.document, "V̇ < 0 on V = 1")


def lemma_decay(
    V: Polynomial,
    field: Sequence[Polynomial],
    states: Sequence[str],
    *,
    rate: float,
    sigma: float,
    domain: Sequence[Polynomial] = (),
    degree: int | None = None,
) -> Lemma:
    """Lemma 5.3: V̇ ≤ λ(σ - V) wherever σ ≤ V ≤ 1: every V ≤ r, r in (σ, 1], is a funnel.

    And V(t) ≤ σ + exp(-λ(t - τ))(V(τ) - σ), thesis (5.4). rate: λ > 0 in 1/s; sigma: in [0, 1).
    """
    if not (rate > 0 and 0 <= sigma < 1):
        raise DataError(f"rate {rate} should be positive and sigma {sigma} in [0, 1)")
    change = derivative(V, field, states)
    wide = V.over(change.names)
    found = lower_bound(
        rate * (sigma - wide) - change, domain=[*domain, wide - sigma, 1 - wide], degree=degree
    )
    return _positive(found.value, found.document, "V̇ <= λ(σ - V) on σ <= V <= 1")


def derivative(V: Polynomial, field: Sequence[Polynomial], states: Sequence[str]) -> Polynomial:
    """V̇ along the field."""
    if len(field) != len(states):
        raise DataError(f"{len(field)} rates for the states {', '.join(states)}")
    total = V.derivative("t")
    for name, f in zip(states, field, strict=True):
        total = total + V.derivative(name) * f
    result: Polynomial = total
    return result


def _positive(margin: float, proof: Json, what: str) -> Lemma:
    if margin <= 0:
        raise Infeasible(f"{what} is not proved: the best bound found is {margin:.3g}")
    return Lemma(margin, proof)
