"""Two things are never told by the same words; a range that is told is one; sizes are bounded."""

import copy
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest

from nlsid_core import proofs
from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import Rejected, increments, sampled_funnel, terms, tube
from nlsid_core.kernel.files import MAX_STATED, Terms
from nlsid_core.kernel.levels import WORDS
from nlsid_core.kernel.polynomials import CALL, Ring, Work
from tests.core.kernel.sampled_claims import Scalar
from tests.core.kernel.stability_claims import claim as stable
from tests.core.kernel.stability_claims import decide as decide_stable
from tests.core.kernel.tube_claims import claim, decide

STILL = Scalar(
    {(1, 0): 0.5, (0, 1): 1.0}, x=[0.0, 0.0], u=[0.0], K=[0.0], S=[1.0, 1.0], A=[0.0],
    tube=[1.0, 1.0], inlet=[1.0, 1.0], reach={c: [0.75] for c in ("tube", "inlet")},
    sigma={c: [[[0.5]]] for c in ("tube", "inlet")}, curvature=[0.5],
)  # fmt: skip


def test_an_input_with_the_name_of_an_output_or_a_state_is_called_the_input() -> None:
    model, funnel, proof = copy.deepcopy(claim("implicit_box"))
    name = model["y"][0]["name"]
    model["u"][0] |= {"name": name, "unit": ""}
    said = decide(model, funnel, proof).assumptions[1]
    y, u = (funnel["box"][key][0] for key in "yu")
    assert f" stay in {name} in [{y[0]:g}, {y[1]:g}]" in said
    assert said.endswith(f", input {name} in [{u[0]:g}, {u[1]:g}]")
    same = replace(STILL, name="input").decide().statement
    box = "[-1.33e+36, 1.33e+36]"
    assert same.endswith(f"the model's data, input in {box} m, input input in {box}")


def test_two_states_of_one_name_are_refused() -> None:
    documents = STILL.documents()
    documents["model"]["x"] *= 2
    with pytest.raises(CertificateRejected, match="two states have the same name"):
        STILL.decide(**documents)


@pytest.mark.parametrize("name", ["a-b", "a/b", "a^2", "a*b", *WORDS])
def test_a_name_that_reads_as_a_formula_is_quoted_in_one(name: str) -> None:
    model, funnel, proof = copy.deepcopy(claim("following"))
    model["u"]["name"] = name
    said = " ".join(decide(model, funnel, proof).assumptions)
    assert f'("{name}"' in said or f'(change of "{name}"' in said
    assert f"({name} /" not in said
    assert f" of {name} /" not in said


def test_a_narrow_range_is_told_with_as_many_digits_as_leave_one() -> None:
    """Rounded inward to four digits, [1000000009, 1000000011] was [1.001e+09, 1e+09]."""
    model, proof = copy.deepcopy(stable("quadratic"))
    (low, high), (offset,), (scale,) = model["u_range"][0], model["u_offset"], model["u_scale"]
    far = 1000000010.0  # the box of the proof stays as it is
    model |= {"u_range": [[far - 1, far + 1]], "u_scale": [2 * scale / (high - low)],
              "u_offset": [far - (low + high - 2 * offset) / (high - low)]}  # fmt: skip
    assert "in [1000000009, 1000000011]" in decide_stable(model, proof).statement


def test_polynomials_too_long_to_print_are_named_by_their_place() -> None:
    n = 30
    long = {"exponents": [[2 * k] for k in range(n)],
            "coefficients": [f"{3**200 + k}/{7**200}" for k in range(n)]}  # fmt: skip
    stated = {"kind": "polynomial_bound", "about": {}, "variables": ["x"], "polynomial": long,
              "bound": 0, "domain": [long, long]}  # fmt: skip
    proof = {"basis": [[k] for k in range(n)], "columns": [0] * n,
             "squares": {"unit": 0, "factors": [[]]}}  # fmt: skip
    size = "of degree 58 with 30 terms >= 0"
    assert proofs.decide(proofs.proof_document(stated, proof), {}).statement == (
        f"the claim's polynomial {size} for all real x with the claim's domain[0] {size} and the "
        f"claim's domain[1] {size}"
    )


def state_affine(outputs: int, G: list[Any]) -> Any:
    """A model of one input and its four delays; nothing but its size matters."""
    signals = [{"name": f"s{i}", "unit": "", "path": ""} for i in range(outputs)]
    return {
        "format": "nlsid/model", "version": 2, "kind": "state_affine", "period": 1, "bags": [],
        "training": "", "y": signals, "u": signals[:1], "window": [[0, i] for i in range(5)],
        "G": G, "p": {"exponents": [[0] * 5], "coefficients": [[0] * outputs]},
        "y_offset": [0] * outputs, "y_scale": [1] * outputs, "u_offset": [0], "u_scale": [1],
        "u_range": [[0, 1]], "on_out_of_range": "clip",
    }  # fmt: skip


def powers(count: int, first: int = 0) -> list[list[int]]:
    """Different exponents of five variables, of 20 at most."""
    return [[(first + i) // 21**k % 21 for k in range(5)] for i in range(count)]


@pytest.mark.slow
def test_a_model_whose_matrix_does_not_fit_in_memory_is_refused_before_it_is_built() -> None:
    """1190 states and 10 outputs: 145 000 monomials of 32 MiB were to be 17 GB."""

    def terms(exponents: list[list[int]], outputs: int) -> Any:
        block = [[0] * outputs] * outputs
        return {"exponents": exponents, "coefficients": [block] * len(exponents)}

    proof, many = {"P": [[1]], "multipliers": {"N": [[1]]}}, terms(powers(MAX_STATED + 1), 1)
    for model, reason in (
        (state_affine(10, [terms(powers(100), 10)] + [terms(powers(1), 10)] * 119), "1190 states"),
        (state_affine(1, [terms(powers(1), 1), many]), "20001 terms; at most 20000"),
        (
            state_affine(1, [terms(powers(10_001, k), 1) for k in (0, 10_001, 0, 0, 0)]),
            "20002 mono",
        ),
    ):
        about = {"model": proofs.binding("model.json", model)}
        stated = {"kind": "stability", "about": about, "rate": 0.5}
        with pytest.raises(CertificateRejected, match=reason):
            proofs.decide(proofs.proof_document(stated, proof), {"model.json": model})


@pytest.mark.slow
def test_ends_of_a_box_whose_matrix_does_not_fit_in_memory_are_refused_before_it_is_built() -> None:
    """80 000 times the same input in a window: 1.4 MB were to be a matrix of 48 GB."""
    none = [0] * 80_000
    one = {"exponents": [none], "coefficients": [[[1]]]}
    model = state_affine(1, [one, one]) | {
        "window": [[0, 0]] * len(none), "p": {"exponents": [none], "coefficients": [[0]]},
    }  # fmt: skip
    ends = {"low": 0.5, "high": 2, "low_weights": none, "high_weights": none}
    proof = {"P": [[1]], "multipliers": {"N": [[1], [0]], "ends": ends}}
    about = {"model": proofs.binding("model.json", model)}
    stated = {"kind": "stability", "about": about, "rate": 0.5}
    with pytest.raises(CertificateRejected, match="at most 199 entries of the box"):
        proofs.decide(proofs.proof_document(stated, proof), {"model.json": model})


def test_derivatives_are_counted_before_they_are_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 equations of 19 000 terms in 35 variables: five million lists, 4 GB of a 3 MB model."""
    ps: list[Terms] = [[((1, 2), Fraction(1)), ((0, 1), Fraction(2))]] * 3
    for missing in (0, 1):
        ring = Ring(2, 64, Work(CALL * 2 * 6 - missing))
        listed: list[int] = []
        monkeypatch.setattr(terms, "derivative", lambda p, j, listed=listed: listed.append(j) or p)
        with pytest.raises(Rejected, match="more products"):
            terms.along(ps, ring.variables, ring.variables, ring)
        assert len(listed) == (0 if missing else 6)


def test_bounds_of_curvature_are_counted() -> None:
    """2000 steps of 8 states and 165 monomials took a minute that nobody counted."""
    ring = Ring(2, 64, Work())
    p = [ring.monomial((1, 1)) + ring.monomial((0, 2))] * 2
    sampled_funnel.prove_curvature(p, [Fraction(0), Fraction(2)], ring, 1)
    ring.work.left = sampled_funnel.ENTRY * 2 * 4 - 1
    with pytest.raises(Rejected, match="more products"):
        sampled_funnel.prove_curvature(p, [Fraction(0), Fraction(2)], ring, 1)


def test_all_tubes_of_a_claim_share_one_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight tubes of 30 MB were to take eight minutes, each within its own budget."""
    model, funnel, proof = copy.deepcopy(claim("implicit_ray"))
    members = funnel["tubes"], proof["multipliers"]
    for entries in members:
        del entries[1:]
    spent: list[Work] = []

    def begun(most: int) -> Work:
        spent.append(Work(most))
        return spent[-1]

    monkeypatch.setattr(tube, "Work", begun)
    decide(model, funnel, proof)
    used = increments.MAX_WORK - spent[0].left
    assert used > increments.MATRIX
    monkeypatch.setattr(tube, "MAX_WORK", used)
    decide(model, funnel, proof)
    for entries in members:
        entries.append(entries[0])
    with pytest.raises(CertificateRejected, match="takes too long to decide: too many"):
        decide(model, funnel, proof)
