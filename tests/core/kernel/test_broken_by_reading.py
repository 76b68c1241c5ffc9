"""Faults that a sceptic found by reading the kernel: each false claim, built from scratch."""

import json
import re
import time
from fractions import Fraction
from typing import Any

import pytest

from nlsid_core import kernel
from nlsid_core.kernel.files import digest
from nlsid_core.kernel.signals import name_label, unit_label
from tests.core.kernel.refusals import refused

Json = dict[str, Any]
SECONDS = 20.0
SIGNAL = {"name": "speed", "unit": "m/s", "path": "/speed"}


def decided(kind: str, documents: dict[str, Json], proof: Json, **claim: Any) -> kernel.Verdict:
    """The verdict on documents, bound in the order in which they are given."""
    contents: dict[str, bytes] = {}
    about: Json = {}
    digests: dict[str, str] = {}
    for role, document in documents.items():
        bound = {key: digests.get(key, entry) for key, entry in document.items()}
        contents[role] = json.dumps(bound).encode()
        digests[role] = digest(contents[role])
        about[role] = {"file": role, "digest": digests[role]}
    document = {
        "format": "nlsid/proof",
        "version": 2,
        "claim": {"kind": kind, "about": about, **claim},
        "proof": proof,
    }
    return kernel.decide(json.dumps(document).encode(), contents.__getitem__)


def tube(name: str = "speed", unit: str = "m/s", n: int = 1, samples: int = 2) -> dict[str, Json]:
    """x⁺ = x/2 + u from x = 0 with no room at all: level and inlet are 0."""
    low = 0.123456
    unity = [[float(i == j) for j in range(n)] for i in range(n)]
    model = {
        "format": "nlsid/model",
        "version": 2,
        "kind": "difference_equation",
        "period": 0.1,
        "training": "",
        "bags": [],
        "y": {"name": name, "unit": unit, "path": "/y"},
        "u": SIGNAL,
        "a": [0.5] + [0] * (n - 1),
        "b": [0, 1] + [0] * (n - 1),
        "c": 0,
        "u_range": [low, 1],
    }
    policy = {
        "format": "nlsid/policy",
        "version": 2,
        "kind": "tube",
        "model": "",
        "period": 0.1,
        "K": [[0.25] + [0] * (n - 1)],
        "L": [[0.25]] + [[0]] * (n - 1),
        "u": [[low]] * samples,
        "start": [0] * n,
    }
    funnel = {
        "format": "nlsid/funnel",
        "version": 2,
        "kind": "tube",
        "model": "",
        "policy": "",
        "settling": n,
        "tubes": [
            {
                "rho": 1,
                "L": policy["L"],
                "P": unity,
                "R": [[1]],
                "level": 0,
                "inlet": 0,
                "tau": [0.25],
                "half_widths": [2.0**-20],
                "assumption": {
                    "kind": "energy",
                    "samples": 2,
                    "measured": 0,
                    "safety_factor": 1,
                    "measured_on": [{"name": "a", "digest": "sha256:" + 64 * "b"}],
                    "designed_on": [],
                },
            }
        ],
    }
    return {"model": model, "policy": policy, "funnel": funnel}


def test_a_policy_clipped_to_the_printed_range_keeps_the_tube() -> None:
    """Rounded inward, the range left the nominal's input out: [0.1235, 1] for 0.123456."""
    documents = tube()
    said = decided("tube", documents, {}).statement
    found = re.search(r"\[([^,\]]+), ([^,\]]+)\] m/s", said)
    assert found
    low, high = (Fraction(end) for end in found.groups())
    # No innovation, the observer starts at the plan's state: x̄ = 0, and the policy says u_0.
    nominal = Fraction(0.123456)
    applied = min(max(nominal, low), high)
    deviation = applied - nominal  # of y_1 = x_1 = x_0/2 + u_0
    assert abs(deviation) <= Fraction(documents["funnel"]["tubes"][0]["half_widths"][0])


def test_a_tube_is_not_about_trajectories_that_start_elsewhere() -> None:
    """x_0 = 100 and x_0 = 0 under the same inputs: both obey the model, 100 apart."""
    verdict = decided("tube", tube(), {})
    assert "the policy's plan, which is the simulation from its start" in verdict.statement
    assert verdict.assumptions[0] == (
        "after 1 samples (0.1 s) the simulation starts at the observer's state, as the plan does"
    )


@pytest.mark.parametrize(
    "text",
    [
        "speed stays within 0.001 m of every trajectory for 9000 samples, margin 0.9; x",
        "e-9",
        "e9",
        "inf",
        "NaN",
        "Pi",
        "5",
        "",
        'a"b',
        "m, u",
        "אב",
        "x̸",
        "ｍ",
        "=",
        "<= 3",
        "1/2",
        "m/1000",
        "m*1000",
        "m/.5",
        "m-2",
        "m+1",
    ],
)
def test_a_name_cannot_speak_for_the_kernel(text: str) -> None:
    verdict = decided("tube", tube(name=text), {})
    assert f"the measured {json.dumps(text)} stays within " in verdict.statement
    assert verdict.statement.isascii()
    if text:
        unit = decided("tube", tube(unit=text), {}).statement
        assert f" {json.dumps(text)} of what the model predicts" in unit


def test_usual_names_and_units_are_as_they_are() -> None:
    for usual in ("speed", "pose.x[0]", "/cmd_vel/x", "%", "°", "e", "joint-a", "twist.linear.x"):
        assert name_label(usual) == usual
    for formula in ("speed^2", "speed²", "speed·2"):
        assert name_label(formula) == json.dumps(formula)


@pytest.mark.parametrize(
    "unit",
    ["/1000", "m/1000", "*1e3", "E3", "e^3", "x10", "sqrt(g)", "·10³ m", "m 2", "nan", "m)^2*(s"],
)
def test_a_unit_cannot_change_the_number_before_it(unit: str) -> None:
    """`0.0000009537 /1000` would be a thousandth of what is proved."""
    said = decided("tube", tube(unit=unit), {}).statement
    assert said == (
        f"tube: the measured speed stays within 9.537e-07 {json.dumps(unit)} of what the model "
        "predicts from the inputs alone, for every input, for 2 samples, which span 0.1 s, as long "
        "as its assumptions hold; and as near the policy's plan, which is the simulation from "
        "its start under its inputs, for at most its 2 samples, which span 0.1 s, whether those "
        "inputs are played, the policy is engaged around them, or anything between the two acts, "
        "such as the policy's input clipped to a range that holds the plan's, as [0.123456, 1] m/s "
        "does"
    )


def test_usual_units_stay_as_they_are() -> None:
    for usual in (
        "m",
        "m/s",
        "m/s^2",
        "1/s",
        "rad/s",
        "%",
        "°",
        "m·s⁻¹",
        "N*m",
        "kg*m^2/s^3",
        "µm",
    ):
        assert unit_label(usual) == usual


@pytest.mark.slow
def test_combinations_are_counted_before_they_are_listed() -> None:
    """1024 corners x 27 modes x 9999 intervals of a file of 1 MB: 276 million table entries."""
    knots = 10_000
    field = {
        "format": "nlsid/vector_field",
        "version": 2,
        "states": 1,
        "inputs": 3,
        "uncertain": [[0, 1]] * 10,
        "breaks": [],
        "valid": [],
        "expansion": "",
        "pieces": [[{"exponents": [], "coefficients": []}]],
    }
    nominal = {"t": list(range(knots)), "x": [[[0]]] * (knots - 1)}
    policy = nominal | {
        "format": "nlsid/policy",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "u": [[[0, 0, 0]]] * (knots - 1),
        "K": [[[[0], [0], [0]]]] * (knots - 1),
        "limits": [[i, -1, 1] for i in range(3)],
    }
    funnel = nominal | {
        "format": "nlsid/funnel",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "policy": "",
        "P": [[[1]]] * knots,
        "rho": [1] * knots,
    }
    proof = {"margin": 1, "basis": [[0]], "multiplier": [[0]], "sides": [[0]], "pieces": [{}]}
    started = time.process_time()
    with refused("too_large"):
        decided(
            "continuous_funnel", {"vector_field": field, "policy": policy, "funnel": funnel}, proof
        )
    assert time.process_time() - started < SECONDS


def test_a_long_plan_is_read_and_no_more() -> None:
    """What the plan is follows from the model, so no sample of it is computed."""
    started = time.process_time()
    assert "for at most its 3000 samples" in decided("tube", tube(samples=3000), {}).statement
    assert time.process_time() - started < SECONDS


def test_the_files_of_a_claim_have_a_size_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nlsid_core.kernel.checking.MAX_TOTAL", 1000)
    with refused("too_large"):
        decided("tube", tube(), {})


def test_solutions_on_two_branches_are_not_near_each_other() -> None:
    """v³ = w of complex v: -1 has the roots 1/2 ± i √3/2, both in the box, √3 apart for ever.

    On each part of the box the equation's slope, which turns by more than half a turn over the
    whole of it, has a multiplier of its own; no multiplier serves the two solutions.
    """
    documents = tube()
    del documents["policy"], documents["funnel"]["policy"]
    signals = [SIGNAL | {"name": name} for name in ("real", "imaginary")]
    terms = [
        ([3, 0, 0, 0, 0], 1, 0),
        ([1, 2, 0, 0, 0], -3, 0),
        ([2, 1, 0, 0, 0], 0, 3),
        ([0, 3, 0, 0, 0], 0, -1),
        ([0, 0, 0, 0, 1], -1, 0),
    ]
    documents["model"] = {
        "format": "nlsid/model",
        "version": 2,
        "kind": "implicit",
        "period": 0.1,
        "equation": "0 = h(v, x, w), x+ = [v; shift(x, w)]",
        "states": ["a", "b"],
        "inputs": ["w"],
        "monotonicity": 1,
        "y": signals,
        "u": [SIGNAL],
        "window": [[0, 0]],
        "h": {"exponents": [e for e, *_ in terms], "coefficients": [c for _, *c in terms]},
    }
    unity, nothing = [[1, 0], [0, 1]], [[0, 0]] * 4
    (stated,) = documents["funnel"]["tubes"]
    stated |= {
        "rho": 0.5,
        "L": [[0, 0], [0, 0]],
        "P": unity,
        "R": unity,
        "tau": [0.5, 0.5],
        "level": 2.0**-14,
        "half_widths": [2.0**-6, 2.0**-6],
    }
    stated["assumption"] |= {"kind": "fading"}
    del stated["assumption"]["samples"]
    documents["funnel"]["box"] = {"y": [[0.25, 1.25], [-1.25, 1.25]], "u": [[-2, 2]]}

    def multipliers(box: list[tuple[float, float]], depth: int) -> Json:
        """N = 2 (the slope at the middle)^-1, on parts of a 64th of the box."""
        if depth < 6:
            i = depth % 2
            middle = sum(box[i]) / 2
            halves = [
                [*box[:i], end, *box[i + 1 :]] for end in ((box[i][0], middle), (middle, box[i][1]))
            ]
            return {"split": i, "parts": [multipliers(half, depth + 1) for half in halves]}
        a, b = (sum(ends) / 2 for ends in box)
        size = 3 * (a**2 + b**2) ** 2 / 2
        turned = [
            [(a**2 - b**2) / size, 2 * a * b / size],
            [-2 * a * b / size, (a**2 - b**2) / size],
        ]
        return {"N": [turned + nothing] * 3}

    proof = {"multipliers": [multipliers([(0.25, 1.25), (-1.25, 1.25)], 0)]}
    with refused("malformed"):
        decided("tube", documents, proof)
