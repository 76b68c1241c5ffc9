"""A decay that is just true is proved, and its smallest false neighbour is refused."""

from math import exp
from typing import Any

import pytest

from nlsid_core import proofs
from nlsid_core.errors import CertificateRejected
from tests.core.kernel.oracle_continuous import agrees
from tests.funnel_files import FIELD, FUNNEL, POLICY, PROOF, Files, bind

NOTHING: dict[str, Any] = {"columns": [0, 0], "squares": {"unit": 0, "factors": [[]]}}
ONE: dict[str, Any] = {"columns": [0, 0], "squares": {"unit": 0, "factors": [[[1, 0]]]}}


def claim(rate: float, floor: float, tau: list[Any]) -> Files:
    """dx/dt = -x around 0 for 1 s and V = x², which falls as exp(-2t).

    What has to be positive is floor rate + (2 - rate) x² - τ (1 - x²) - τ' (x² - floor).
    """
    field = {
        "format": "nlsid/vector_field", "version": 2, "states": 1, "inputs": 0, "uncertain": [],
        "breaks": [], "valid": [], "expansion": "",
        "pieces": [[{"exponents": [[0, 1]], "coefficients": [-1.0]}]],
    }  # fmt: skip
    policy = {
        "format": "nlsid/policy", "version": 2, "kind": "continuous", "vector_field": "",
        "t": [0.0, 1.0], "x": [[[0.0]]], "u": [[[]]], "K": [[[]]], "limits": [],
    }  # fmt: skip
    funnel = {
        "format": "nlsid/funnel", "version": 2, "kind": "continuous", "vector_field": "",
        "policy": "", "t": [0.0, 1.0], "x": [[[0.0]]], "P": [[[1.0]]] * 2, "rho": [1.0, 1.0],
    }  # fmt: skip
    piece = {"interval": 0, "vertex": 0, "level": 0, "index": 0, "tau": tau, **NOTHING}
    free = [[0], [1]]
    about = {role: {"file": f"{role}.json", "digest": ""}
             for role in ("vector_field", "policy", "funnel")}  # fmt: skip
    stated = {"kind": "continuous_funnel", "about": about,
              "decay": {"rate": rate, "floor": floor}}  # fmt: skip
    proof = {"basis": free, "sides": free, "pieces": [piece]}
    files = {FIELD: field, POLICY: policy, FUNNEL: funnel,
             PROOF: proofs.proof_document(stated, proof)}  # fmt: skip
    bind(files)
    return files


def is_true(rate: float, floor: float) -> bool:
    """Whether solutions that start at V = 1 and V = 1/2 keep what is claimed."""
    return all(
        start * exp(-2 * t) <= max(floor, floor + exp(-rate * t) * (start - floor)) + 1e-12
        for start in (1.0, 0.5)
        for t in (1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0)
    )


@pytest.mark.parametrize(("floor", "true"), [(0.34, True), (0.33, False)])
def test_a_floor_is_as_low_as_the_rate_allows(floor: float, true: bool) -> None:
    """At V = 1 it falls at 2: as fast as 3 (1 - floor) only from a floor of 1/3 on."""
    files = claim(3.0, floor, [ONE, NOTHING])
    assert is_true(3.0, floor) == true
    assert agrees(files[PROOF], files) == true
    if true:
        verdict = proofs.decide(files[PROOF], files)
        assert "V(t2) <= 0.34 or V(t2) <= 0.34 + exp(-3 (t2 - t1)) (V(t1) - 0.34)" in str(verdict)
        assert float(verdict.margin) == pytest.approx(3 * (1 - 0.34))
    else:
        with pytest.raises(CertificateRejected, match="not positive"):
            proofs.decide(files[PROOF], files)


@pytest.mark.parametrize(("rate", "floor"), [(0.0, 0.5), (-1.0, 0.5), (1.0, 1.0), (1.0, -0.1)])
def test_a_decay_is_a_rate_above_0_and_a_floor_below_1(rate: float, floor: float) -> None:
    files = claim(rate, floor, [NOTHING, NOTHING])
    assert not agrees(files[PROOF], files)
    with pytest.raises(CertificateRejected, match="a rate above 0 and a floor"):
        proofs.decide(files[PROOF], files)


def test_a_multiplier_of_the_wrong_side_proves_nothing() -> None:
    """τ' times x² - floor, which grows with x, in the place of τ times 1 - x²."""
    files = claim(3.0, 0.34, [NOTHING, ONE])
    assert not agrees(files[PROOF], files)
    with pytest.raises(CertificateRejected, match="not positive"):
        proofs.decide(files[PROOF], files)


@pytest.mark.parametrize("tau", [[], [ONE], [ONE, NOTHING, NOTHING]])
def test_both_sides_of_the_shell_have_one_multiplier(tau: list[Any]) -> None:
    files = claim(3.0, 0.34, tau)
    assert not agrees(files[PROOF], files)
    with pytest.raises(CertificateRejected, match="2 to 2 entries"):
        proofs.decide(files[PROOF], files)


def test_a_claim_of_a_decay_is_proved_by_nothing_else() -> None:
    """A margin, a μ and its monomials belong to claims without one, which state no decay."""
    for member, value in (("margin", 1.0), ("multiplier", [[0]])):
        files = claim(3.0, 0.34, [ONE, NOTHING])
        files[PROOF]["proof"][member] = value
        assert not agrees(files[PROOF], files)
        with pytest.raises(CertificateRejected, match=f"unknown member '{member}'"):
            proofs.decide(files[PROOF], files)
    files = claim(3.0, 0.34, [ONE, NOTHING])
    del files[PROOF]["claim"]["decay"]
    with pytest.raises(CertificateRejected, match="is missing"):
        proofs.decide(files[PROOF], files)
