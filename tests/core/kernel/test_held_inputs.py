"""A held input of a clipped policy may be older than the bounds that it has to keep."""

from fractions import Fraction
from itertools import product
from typing import Any

import pytest

from nlsid_core import proofs
from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import Verdict
from tests.core.kernel.oracle_continuous import agrees
from tests.funnel_files import FIELD, FUNNEL, POLICY, PROOF, Files, bind

HOLD, LIMITS = 1.0, (-1.0, 1.0)
TIMES = [0.0, 1.0, 1.25, 2.25]
WANTED = [(0.25, 1.125), (1.125, 3.0), (3.0, 3.0)]  # u₀ at both ends of each interval


def claim(low: float) -> Files:
    """dx/dt = -x, valid for u >= low from 1.25 s on; u = clip(u₀) to [-1, 1], held for 1 s."""
    free, nothing = [[0], [1]], {"unit": 0, "factors": [[]]}
    field = {
        "format": "nlsid/vector_field", "version": 2, "states": 1, "inputs": 1, "uncertain": [],
        "breaks": [1.25], "valid": [[1, low, 10.0, 1]], "expansion": "",
        "pieces": [[{"exponents": [[0, 1, 0]], "coefficients": [-1.0]}]] * 2,
    }  # fmt: skip
    policy = {
        "format": "nlsid/policy", "version": 2, "kind": "continuous", "vector_field": "",
        "t": TIMES, "x": [[[0.0]]] * 3, "u": [[[a], [b]] for a, b in WANTED],
        "K": [[[[0.0]]]] * 3, "limits": [[0, *LIMITS]],
    }  # fmt: skip
    funnel = {
        "format": "nlsid/funnel", "version": 2, "kind": "continuous", "vector_field": "",
        "policy": "", "t": TIMES, "x": [[[0.0]]] * 3, "P": [[[1.0]]] * 4, "rho": [1.0] * 4,
    }  # fmt: skip

    def witness(k: int, root: int) -> dict[str, Any]:
        """r is the whole polynomial; τ = root² for what holds in the mode."""
        tau = {"columns": [0, 0], "squares": {"unit": 0, "factors": [[[root, 0]]]}}
        return {"interval": k, "level": 0, "index": 0, "columns": [0, 0], "squares": nothing,
                "tau": [tau]}  # fmt: skip

    lengths = [[int(4 * (TIMES[k + 1] - TIMES[k])), 0] for k in range(3)]
    mu = [{"shifts": [-2, 0], "start": h, "end": h} for h in lengths]  # μ = h
    pieces = [
        {**witness(k, 0), "vertex": v, "mode": [mode], "mu": mu[k]}
        for k, v, mode in product(range(3), range(2), (-1, 0, 1))
    ]
    rates: list[dict[str, Any]] = []
    for k, v, sign in product(range(3), range(2), (-1, 1)):
        # u₀ climbs faster than R where it is beyond its limit: 3 (ũ² - 1) h R is added there.
        piece = witness(k, 3 if (k, sign) == (1, 1) else 0)
        still = {"columns": [0, 0], "squares": nothing}
        piece |= {"vertex": v, "mode": [0], "input": 0, "sign": sign, "tau": [still, *piece["tau"]]}
        rates.append(piece)
    proof = {
        "margin": 0.5, "basis": free, "multiplier": free, "sides": free, "pieces": pieces,
        "rates": [[1.0]] * 3, "rate_pieces": rates,
    }  # fmt: skip
    about = {role: {"file": f"{role}.json", "digest": ""}
             for role in ("vector_field", "policy", "funnel")}  # fmt: skip
    stated = {"kind": "continuous_funnel", "about": about, "hold": HOLD}
    files = {FIELD: field, POLICY: policy, FUNNEL: funnel,
             PROOF: proofs.proof_document(stated, proof)}  # fmt: skip
    bind(files)
    return files


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
        with pytest.raises(CertificateRejected, match="the limits of u0 lie where its dynamics"):
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
