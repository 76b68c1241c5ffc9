"""Held inputs: what bounds they have to keep, and how fast the policy may change them."""

from fractions import Fraction

import pytest

from nlsid_core import proofs
from nlsid_core.kernel import Verdict
from tests.core.kernel.held_claims import HOLD, LIMITS, TIMES, WANTED, claim, integrator
from tests.core.kernel.oracle_continuous import agrees
from tests.core.kernel.refusals import refused
from tests.funnel_files import PROOF, Files


def decided(files: Files) -> Verdict:
    return proofs.decide(files[PROOF], files)


def wanted(t: Fraction) -> Fraction:
    """u₀(t)."""
    k = max(k for k in range(3) if TIMES[k] <= t)
    start, end = (Fraction(TIMES[j]) for j in (k, k + 1))
    a, b = map(Fraction, WANTED[k])
    return a + (b - a) * (t - start) / (end - start)


def test_an_input_held_from_before_a_bound_began_may_be_outside_it() -> None:
    """At 1.25 s u₀ is 3, beyond the limit 1; the input held since 0.25 s is 0.46875, below 1."""
    least, most = map(Fraction, LIMITS)
    since = Fraction(TIMES[2]) - Fraction(HOLD)
    applied = min(max(wanted(since), least), most)
    assert applied == Fraction("0.46875")
    for low in (0.5, 1.0):
        assert applied < low <= most  # so the equations do not describe what happens
        files = claim(low)
        with refused("not_valid"):
            decided(files)
        assert not agrees(files[PROOF], files)


def test_a_bound_that_the_oldest_held_input_keeps_is_proved() -> None:
    """The input falls by at most 1 a second: held for 1 s it is at least 0."""
    files = claim(0.0)
    verdict = decided(files)
    assert "starts in it" in verdict.statement
    assert verdict.assumptions == (
        "the state obeys the stored equations and the stored policy is applied every 1 s or more "
        "often: at every time, the input is the policy's of some time at most 1 s before, and not "
        "before the solution's start, for the state then, u0 clipped to [-1, 1]",
    )
    assert agrees(files[PROOF], files)


@pytest.mark.parametrize("rate", [1.375, 1.34375, 1.328125, 1.3125, 1.25])
def test_what_an_input_that_only_pushes_is_off_by_is_taken_off_its_rate(rate: float) -> None:
    """At x = 1, off by δ = -rate/4, u changes by 1 + rate/4 a second: below rate from 4/3 on."""
    off, fastest = Fraction(rate) / 4, Fraction(0)
    for x in (-1, 1):
        for delta in (-off, off):
            fastest = max(fastest, abs(-(-x + delta)))
    files = integrator(rate)
    assert agrees(files[PROOF], files) == (fastest < Fraction(rate))
    if fastest < Fraction(rate):
        assert "4 pieces of time" in decided(files).statement
    else:
        with refused("not_positive"):
            decided(files)
