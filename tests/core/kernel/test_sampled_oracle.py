"""The kernel's sampled funnels against an oracle that evaluates the documents point by point."""

import random
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.design import SampledTracking
from nlsid_core.design.sampled import closed_loop
from nlsid_core.design.sampled.design import TrackingDesign, design_state_funnel
from nlsid_core.design.sampled.motion import track, tvlqr
from nlsid_core.designs import PROOF, AnyDesign
from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import Rejected, Verdict, positivity, sampled_funnel
from nlsid_core.kernel.polynomials import BITS, Polynomial, Ring
from nlsid_core.kernel.sampled_step import prove_curvature, stretch
from tests.core.kernel import oracle_sampled as oracle
from tests.implicit_funnels import designed as implicit
from tests.implicit_funnels import two_joints
from tests.implicit_pendulum import truth
from tests.tracked import assumption
from tests.tracked import designed as explicit

# At each step of each chain. Two different polynomials of degree 6 agree at one with probability
# 6/1999 at most (Schwartz and Zippel), at all three with less than 3e-8.
POINTS = 3


@pytest.fixture
def rebuilt(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Polynomial, Ring]]:
    """What the kernel asks to be nonnegative, by name, as it decides."""
    found: list[tuple[str, Polynomial, Ring]] = []
    original = positivity.positive

    def noting(c: Polynomial, squares: Any, ring: Ring, what: str, *, strict: bool) -> None:
        found.append((what, c, ring))
        original(c, squares, ring, what, strict=strict)

    monkeypatch.setattr(sampled_funnel, "positive", noting)
    return found


def decide(design: AnyDesign) -> Verdict:
    """The kernel's verdict on a design's documents."""
    documents = design.documents()
    return proofs.decide(documents[PROOF], documents)


def value(p: Polynomial, ring: Ring, point: list[Fraction]) -> Fraction:
    """p at a point, from its packed terms."""
    total = Fraction(0)
    for key, coefficient in p.terms.items():
        term = Fraction(coefficient, p.denominator)
        for i, x in enumerate(point):
            term *= x ** ((key >> (BITS * i)) & (2**BITS - 1))
        total += term
    assert len(point) == ring.count
    return total


CASES = [explicit, *(pytest.param(make, marks=pytest.mark.slow) for make in (implicit, two_joints))]


@pytest.mark.parametrize("make", CASES)
def test_every_rebuilt_polynomial_is_the_oracles_at_rational_points(
    make: Callable[[], TrackingDesign],
    rebuilt: list[tuple[str, Polynomial, Ring]],
) -> None:
    design = make()
    documents = {name.removesuffix(".json"): part for name, part in design.documents().items()}
    rebuilt.clear()  # making the design has decided it once
    decide(design)
    rng = random.Random(0)
    del rebuilt[: -2 * len(design.policy)]  # of widths that were too narrow
    for i, (what, c, ring) in enumerate(rebuilt):
        k, chain = i // 2, ("tube", "inlet")[i % 2]
        assert what == f"{chain}, step {k}: reach"
        for _ in range(POINTS):
            point = [
                Fraction(rng.randint(-999, 999), rng.randint(1, 99)) for _ in range(ring.count)
            ]
            claimed = oracle.claimed_at(documents, design.proof, chain, k, point)
            assert value(c, ring, point) == claimed


@pytest.mark.parametrize("make", CASES)
def test_a_reach_holds_for_the_oracle_at_random_states_of_the_set(
    make: Callable[[], TrackingDesign],
) -> None:
    """|S x̄| <= radius implies |S⁺ f̄(x̄)| <= reach, at rational points; an implicit one by roots."""
    design = make()
    model, policy = design.model.document(), design.policy.document()
    rng = random.Random(0)
    for k in range(len(design.policy)):
        S, S_next = (oracle.fractions(design.funnel.S[i].tolist()) for i in (k, k + 1))
        for chain in ("tube", "inlet"):
            reach = Fraction(design.proof["steps"][k][chain]["reach"])
            radius = Fraction(float(getattr(design.funnel, chain)[k]))
            deviation = [Fraction(rng.randint(-99, 99)) for _ in design.model.x]
            size = oracle.size2(oracle.times(S, deviation))
            scale = radius / Fraction(float(size) ** 0.5 * (1 + 1e-12))
            deviation = [scale * entry for entry in deviation]
            assert oracle.size2(oracle.times(S, deviation)) <= radius**2
            if design.funnel.roots is None:
                after = oracle.explicit_next(model, policy, k, deviation)
                assert oracle.size2(oracle.times(S_next, after)) <= reach**2
                continue
            x = design.policy.x[k] + [float(entry) for entry in deviation]
            d = len(x) // 2
            rate = design.model(x, design.policy(k, x))[d:] - design.policy.x[k + 1][d:]
            after, h = oracle.implicit_next(
                model, policy, k, deviation, oracle.fractions(rate.tolist())
            )
            assert max(map(abs, h)) < Fraction(1, 10**12)  # the root, to float rounding
            assert oracle.size2(oracle.times(S_next, after)) <= reach**2 * (1 + Fraction(1, 10**9))


def test_a_spurious_root_within_the_bound_makes_a_claim_false_and_is_refused() -> None:
    """v⁺ = v + h/2 (8 v³ + 8 v⁺³ + 2u), h = 2⁻⁶: from rest, v⁺ = 0 and v⁺ = 4 are both roots."""
    model = replace(
        truth(),
        exponents=np.array([[0, 3, 0], [0, 0, 1]]),
        coefficients=np.array([[8.0], [1.0]]),
        period=2.0**-6,
    )
    x, u = np.zeros((3, 2)), np.zeros((2, 1))
    feedback = tvlqr(model, x, u, input_weight=0.3)
    policy = track(model, x, u, feedback)
    design = design_state_funnel(
        SampledTracking(model, policy, feedback, assumption=assumption(0.001), goal=0.05)
    )
    spurious, rest = [Fraction(4)], [Fraction(0)] * 2
    after, h = oracle.implicit_next(model.document(), policy.document(), 0, rest, spurious)
    assert h == [0]
    S = oracle.fractions(design.funnel.S[1].tolist())
    assert oracle.size2(oracle.times(S, after)) > Fraction(float(design.funnel.inlet[1])) ** 2
    assert design.funnel.roots is not None
    far = float(abs(S[1][1]) * spurious[0]) * 1.001
    assert far > design.funnel.roots[1]  # as designed, the bound keeps it out
    funnel = replace(design.funnel, roots=np.full(3, far))
    with pytest.raises(CertificateRejected):
        decide(replace(design, funnel=funnel))


def rational_direction(rng: random.Random) -> list[Fraction]:
    """A point of the unit circle."""
    t = Fraction(rng.randint(-50, 50), rng.randint(1, 50))
    return [(1 - t**2) / (1 + t**2), 2 * t / (1 + t**2)]


@pytest.mark.parametrize("seed", range(20))
def test_the_bound_on_a_polynomials_change_holds_at_rational_points(seed: int) -> None:
    rng = random.Random(seed)
    ring = closed_loop.ring_of(2)
    exponents: list[tuple[int, ...]] = [(i, j) for i in range(4) for j in range(4) if 0 < i + j < 4]
    p = [
        closed_loop.polynomial({e: Fraction(rng.randint(-99, 99), 64) for e in exponents}, ring)
        for _ in range(2)
    ]
    gammas = [Fraction(g) for g in closed_loop.curvature_bounds(p, ring, 1)]
    prove_curvature(p, gammas, ring, 1)
    for m in range(3):
        smaller = [g * (1 - Fraction(1, 10**6) * (i == m)) for i, g in enumerate(gammas)]
        with pytest.raises(Rejected, match=f"degree {m + 1}"):
            prove_curvature(p, smaller, ring, 1)
    for _ in range(40):
        size, step = (Fraction(rng.randint(1, 60), 20) for _ in range(2))
        z, w = ([r * e for e in rational_direction(rng)] for r in (size, step))
        moved = [value(q, ring, oracle.plus(z, w)) - value(q, ring, z) for q in p]
        assert oracle.size2(moved) <= (stretch(gammas, size, step, 1) * step) ** 2


@pytest.mark.parametrize("seed", range(20))
def test_half_widths_of_ill_conditioned_shapes_are_above_the_true_ones(seed: int) -> None:
    """By |x̄_i| = |e_i'S⁻¹(S x̄)|, S⁻¹ by exact elimination; a float inverse may be 50 times off."""
    rng = random.Random(seed)
    S = [[rng.uniform(-1, 1) * 2.0 ** rng.randint(-40, 40) for _ in range(3)] for _ in range(3)]
    for i in range(3):
        S[i][:i] = [0.0] * i
    (found,) = closed_loop.half_widths(np.array([S]), np.array([0.7]), 0.1)
    exact = oracle.fractions(S)
    columns = []
    for i in range(3):  # S x = e_i, from the last row up
        x = [Fraction(0)] * 3
        for row in (2, 1, 0):
            known = sum((exact[row][j] * x[j] for j in range(row + 1, 3)), Fraction(0))
            x[row] = (Fraction(int(row == i)) - known) / exact[row][row]
        columns.append(x)
    for i, width in enumerate(found.tolist()):
        true = (Fraction(0.7) + Fraction(0.1)) ** 2 * sum(column[i] ** 2 for column in columns)
        assert true <= Fraction(width) ** 2 <= true * (1 + Fraction(1, 10**12))
