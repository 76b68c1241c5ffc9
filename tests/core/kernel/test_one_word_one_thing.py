"""Two things are never told by the same words; a range that is told is one."""

import copy
from dataclasses import replace

import pytest

from nlsid_core.kernel.tube import WORDS
from tests.core.kernel.refusals import refused
from tests.core.kernel.sampled_claims import Scalar
from tests.core.kernel.stability_claims import claim as stable
from tests.core.kernel.stability_claims import decide as decide_stable
from tests.core.kernel.tube_claims import claim, decide

STILL = Scalar(
    {(1, 0): 0.5, (0, 1): 1.0},
    x=[0.0, 0.0],
    u=[0.0],
    K=[0.0],
    S=[1.0, 1.0],
    A=[0.0],
    tube=[1.0, 1.0],
    inlet=[1.0, 1.0],
    reach={c: [0.75] for c in ("tube", "inlet")},
    sigma={c: [[[0.5]]] for c in ("tube", "inlet")},
    curvature=[0.5],
)


def test_an_input_with_the_name_of_an_output_or_a_state_is_called_the_input() -> None:
    model, funnel, proof = copy.deepcopy(claim("implicit_box"))
    name = model["y"][0]["name"]
    model["u"][0] |= {"name": name, "unit": ""}
    said = decide(model, funnel, proof).assumptions[1]
    y, u = (funnel["box"][key][0] for key in "yu")
    assert f" stay in {name} in [{y[0]:g}, {y[1]:g}]" in said
    assert said.endswith(f", input {name} in [{u[0]:g}, {u[1]:g}]; that any do is not stated")
    same = replace(STILL, name="input").decide().statement
    box = "[-1.33e+36, 1.33e+36]"
    assert same.endswith(f"the model's data, input in {box} m, input input in {box}")


def test_two_states_of_one_name_are_refused() -> None:
    documents = STILL.documents()
    documents["model"]["x"] *= 2
    with refused("malformed"):
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
    model |= {
        "u_range": [[far - 1, far + 1]],
        "u_scale": [2 * scale / (high - low)],
        "u_offset": [far - (low + high - 2 * offset) / (high - low)],
    }
    assert "in [1000000009, 1000000011]" in decide_stable(model, proof).statement
