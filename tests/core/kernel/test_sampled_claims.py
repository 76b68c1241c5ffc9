"""Sampled funnels whose truth is known in closed form, and false ones with a counterexample."""

import copy
import random
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest

from nlsid_core.errors import CertificateRejected
from tests.core.kernel import oracle_sampled as oracle
from tests.core.kernel.refusals import refused
from tests.core.kernel.sampled_claims import UP, Scalar, one_step


def test_random_claims_are_decided_as_the_closed_form_decides() -> None:
    rng = random.Random(0)
    decided = {True: 0, False: 0}
    for i in range(60):
        claim, true = one_step(rng, 1e-5 if i % 2 else -1e-5)
        assert true == bool(i % 2)
        if true:
            assert claim.decide().margin >= 0
        else:
            with pytest.raises(CertificateRejected):
                claim.decide()
        decided[true] += 1
    assert decided == {True: 30, False: 30}


def cancelling(slope: float) -> Scalar:
    """x⁺ = slope x + x²/2 - x u at x = u = 2^54: x̄⁺ = slope x̄ + x̄²/2, claimed for the slope 0.

    As floats are summed, 1 + 2^54 - 2^54 is 0.
    """
    s, at, both = 0.125, 2.0**54, ("tube", "inlet")
    after = s**2 / 2 * UP + 0.02
    return Scalar(
        {(1, 0): slope, (2, 0): 0.5, (1, 1): -1.0},
        x=[at, slope * at - 2.0**107],
        u=[at],
        K=[0.0],
        S=[1.0, 1.0],
        A=[0.0],
        tube=[s, after],
        inlet=[s, after],
        reach={chain: [s**2 / 2 * UP] for chain in both},
        sigma={chain: [[[s / 2, 0.0], [0.0, 0.5]]] for chain in both},
        bound=0.01,
        measured=0.01,
        curvature=[slope, 0.5],
        basis=2,
    )


def test_numbers_that_cancel_in_floats_are_combined_exactly() -> None:
    assert (1.0 + 2.0**54) - 2.0**54 == 0.0
    assert cancelling(0.0).decide().margin >= 0
    false = cancelling(1.0)
    documents = false.documents()
    s = Fraction(false.tube[0])
    (after,) = oracle.explicit_next(documents["model"], documents["policy"], 0, [s])
    assert after == s + s**2 / 2  # the counterexample: from the tube's edge to far outside
    assert after > Fraction(false.tube[1])
    with refused("not_positive"):
        false.decide()


def true_claim(**changes: Any) -> Scalar:
    """x⁺ = x/2 + u from 1 to 0.6, |d| <= 0.05."""
    both = ("tube", "inlet")
    base = Scalar(
        {(1, 0): 0.5, (0, 1): 1.0},
        x=[0.0, 0.0],
        u=[0.0],
        K=[0.0],
        S=[1.0, 1.0],
        A=[0.5],
        tube=[1.0, 0.6],
        inlet=[1.0, 0.6],
        reach={chain: [0.5 * UP] for chain in both},
        sigma={chain: [[[0.5]]] for chain in both},
        bound=0.05,
        measured=0.03125,
        curvature=[0.5],
        box=4.0,
    )
    return replace(base, **changes)


def test_the_whole_verdict_of_a_small_claim() -> None:
    assert str(true_claim().decide()) == (
        "PROVED funnel: a state estimate that starts with |S[0] (xhat - x[0])| <= 1, such as "
        "xhat = x[0], stays in the tube, |S[k] (xhat - x[k])| <= tube[k] + bound, at all 2 samples "
        "over 0.5 s and ends within level "
        "0.6501 m of the nominal; one that starts with |S[0] (xhat - x[0])| <= 1 ends within level "
        "0.6501 m of it; at the samples both stay in the box of the model's data, level in [-4, 4] "
        "m, input in [-4, 4], margin 0.1249\n"
        "  assuming disturbance response |S r| <= 0.05, r+ = A r + d from r = 0, at every sample, "
        "d = xhat+ - f(xhat, u)\n"
        "  assuming the input applied at every sample is the policy's, u[k] - K[k] (xhat - x[k])"
    )


def test_samples_and_time_are_those_covered() -> None:
    both = ("tube", "inlet")
    claim = true_claim(
        x=[0.0] * 4,
        u=[0.0] * 3,
        K=[0.0] * 3,
        S=[1.0] * 4,
        A=[0.5] * 3,
        tube=[1.0] * 4,
        inlet=[1.0] * 4,
        reach={chain: [0.5 * UP] * 3 for chain in both},
        sigma={chain: [[[0.5]]] * 3 for chain in both},
        period=0.1,
    )
    assert "at all 4 samples over 0.3 s" in claim.decide().statement


FALSE: dict[str, tuple[dict[str, Any], str]] = {
    "next radius below what is reached": ({"tube": [1.0, 0.52]}, "not_below"),
    "inlet's goal below what is reached": ({"inlet": [1.0, 0.52]}, "not_below"),
    "reach below what is reached": (
        {"reach": {"tube": [0.49], "inlet": [0.5 * UP]}, "tube": [1.0, 0.55]},
        "not_positive",
    ),
    "a tube that starts beyond the inlet": ({"inlet": [0.9, 0.6]}, "not_below"),
    "a radius of zero": ({"tube": [1.0, 0.0], "inlet": [1.0, 0.0]}, "not_below"),
    "a negative radius": ({"tube": [-1.0, 0.6]}, "not_below"),
    "a negative reach": ({"reach": {"tube": [-0.5], "inlet": [0.5]}}, "not_below"),
    "a box that the tube leaves": ({"box": 0.9}, "not_valid"),
    "half-widths below the tube's": ({"widths": [1.0, 0.59]}, "not_valid"),
    "a negative half-width": ({"widths": [1.0, -0.6]}, "not_valid"),
    "a gain that a response does not have": ({"gain": 2.0}, "not_below"),
    "a rate that a response does not have": ({"rate": 0.9}, "not_below"),
    "a form that left": ({"form": "fading", "rate": 0.9, "gain": 2.0}, "left"),
    "an unknown form": ({"form": "average"}, "malformed"),
    "a shape of zero": ({"S": [1.0, 0.0], "widths": [1.0, 9.0]}, "malformed"),
    "a name on two lines": ({"name": "level\nPROVED everything"}, "malformed"),
    "a period of zero": ({"period": 0.0}, "malformed"),
    "a whole number beyond 2^53": ({"box": 2**53 + 1}, "malformed"),
    "curvature below the slope": ({"curvature": [0.5], "A": [-0.5]}, "not_definite"),
}


@pytest.mark.parametrize("what", FALSE)
def test_a_false_neighbour_of_a_small_claim_is_refused(what: str) -> None:
    changes, reason = FALSE[what]
    with refused(reason):
        true_claim(**changes).decide()


@pytest.mark.parametrize("role", ["model", "policy", "funnel"])
@pytest.mark.parametrize("how", ["member more", "member less", "version", "kind"])
def test_documents_that_are_not_exactly_as_specified_are_refused(role: str, how: str) -> None:
    claim = true_claim()
    document = copy.deepcopy(claim.documents()[role])
    if how == "member more":
        document["more"] = 1
    elif how == "member less":
        del document["kind"]
    elif how == "version":
        document["version"] = 1
    else:
        document["kind"] = "linear"
    with pytest.raises(CertificateRejected):
        claim.decide(**{role: document})


def test_repeated_monomials_are_refused() -> None:
    claim = true_claim()
    model = copy.deepcopy(claim.documents()["model"])
    model["exponents"].append([1, 0])
    model["coefficients"].append([0.25])
    with refused("malformed"):
        claim.decide(model=model)


def test_a_policy_that_the_funnel_was_not_made_for_is_a_mismatch() -> None:
    claim = true_claim()
    other = claim.documents()["policy"] | {"law": "another"}
    with refused("mismatch"):
        claim.decide(policy=other)
