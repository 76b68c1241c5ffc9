"""The kernel's sampled funnels against an oracle that evaluates the documents point by point."""

import random
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.design.sampled import closed_loop
from nlsid_core.designs import PROOF, AnyDesign
from nlsid_core.kernel import Rejected, Verdict, positivity, sampled_funnel
from nlsid_core.kernel.polynomials import BITS, Polynomial, Ring
from nlsid_core.kernel.sampled_step import prove_curvature, stretch
from tests.core.kernel import oracle_sampled as oracle
from tests.core.kernel.oracle_continuous import numbers
from tests.tracked import designed

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


def test_every_rebuilt_polynomial_is_the_oracles_at_rational_points(
    rebuilt: list[tuple[str, Polynomial, Ring]],
) -> None:
    design = designed()
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


def test_a_reach_holds_for_the_oracle_at_random_states_of_the_set() -> None:
    """|S x̄| <= radius implies |S⁺ f̄(x̄)| <= reach, at rational points."""
    design = designed()
    model, policy = design.model.document(), design.policy.document()
    rng = random.Random(0)
    for k in range(len(design.policy)):
        S, S_next = (numbers(design.funnel.S[i].tolist()) for i in (k, k + 1))
        for chain in ("tube", "inlet"):
            reach = Fraction(design.proof["steps"][k][chain]["reach"])
            radius = Fraction(float(getattr(design.funnel, chain)[k]))
            deviation = [Fraction(rng.randint(-99, 99)) for _ in design.model.x]
            size = oracle.size2(oracle.times(S, deviation))
            scale = radius / Fraction(float(size) ** 0.5 * (1 + 1e-12))
            deviation = [scale * entry for entry in deviation]
            assert oracle.size2(oracle.times(S, deviation)) <= radius**2
            after = oracle.explicit_next(model, policy, k, deviation)
            assert oracle.size2(oracle.times(S_next, after)) <= reach**2


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
    gammas = [Fraction(g) for g in closed_loop.curvature_bounds(p, ring)]
    prove_curvature(p, gammas, ring)
    for m in range(3):
        smaller = [g * (1 - Fraction(1, 10**6) * (i == m)) for i, g in enumerate(gammas)]
        with pytest.raises(Rejected, match=f"degree {m + 1}"):
            prove_curvature(p, smaller, ring)
    for _ in range(40):
        size, step = (Fraction(rng.randint(1, 60), 20) for _ in range(2))
        z, w = ([r * e for e in rational_direction(rng)] for r in (size, step))
        moved = [value(q, ring, oracle.plus(z, w)) - value(q, ring, z) for q in p]
        assert oracle.size2(moved) <= (stretch(gammas, size, step) * step) ** 2


@pytest.mark.parametrize("seed", range(20))
def test_half_widths_of_ill_conditioned_shapes_are_above_the_true_ones(seed: int) -> None:
    """By |x̄_i| = |e_i'S⁻¹(S x̄)|, S⁻¹ by exact elimination; a float inverse may be 50 times off."""
    rng = random.Random(seed)
    S = [[rng.uniform(-1, 1) * 2.0 ** rng.randint(-40, 40) for _ in range(3)] for _ in range(3)]
    for i in range(3):
        S[i][:i] = [0.0] * i
    (found,) = closed_loop.half_widths(np.array([S]), np.array([0.7]), 0.1)
    exact = numbers(S)
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
