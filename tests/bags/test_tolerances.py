"""Tolerances: every number is the proof's, rounded up, in a file that its reader parses."""

import shutil
from dataclasses import replace
from decimal import ROUND_CEILING, Context, Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import yaml

from bags.designs.tolerances import CONTROLLER, TABLE, VALIDATOR, Tolerance, tolerances
from nlsid_core import files
from nlsid_core.design import OutputTubeDesign
from nlsid_core.designs import FUNNEL, PROOF
from nlsid_core.errors import CertificateRejected, DataError
from nlsid_core.kernel import text
from nlsid_core.models import Signal
from tests.core.kernel.mutations import CORPUS
from tests.tracked import designed
from tests.verbs import nlsid

CONTINUOUS = sorted(path.name for path in (CORPUS / "continuous_funnel").iterdir())[0]


def up(value: float) -> float:
    """Itself if it is short, else four significant digits, upward, by the decimal module."""
    if len(repr(value)) < 8:
        return value
    return float(Context(prec=4, rounding=ROUND_CEILING).create_decimal(Decimal(value)))


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    """A funnel of an angle and its rate."""
    designed().save(tmp_path)
    return tmp_path


def test_path_and_goal_of_a_joint_are_the_proved_half_widths_rounded_up(arm: Path) -> None:
    widths = designed().funnel.half_widths
    found = tolerances(arm)
    found.write(arm)
    content = yaml.safe_load((arm / CONTROLLER).read_text())
    constraints = content["joint_trajectory_controller"]["ros__parameters"]["constraints"]
    assert constraints == {
        "stopped_velocity_tolerance": up(widths[-1, 1]),
        "angle": {"trajectory": up(widths[:, 0].max()), "goal": up(widths[-1, 0])},
    }
    assert constraints["angle"]["trajectory"] >= widths[:, 0].max()
    assert constraints["angle"]["goal"] < constraints["angle"]["trajectory"]
    assert not (arm / VALIDATOR).exists()


def test_every_file_says_the_claim_the_unit_and_what_to_compare_with(arm: Path) -> None:
    found = tolerances(arm)
    written = found.write(arm)
    assert [path.name for path in written] == [CONTROLLER, TABLE]
    for path in written:
        said = path.read_text()
        for line in str(designed().verdict).splitlines():
            assert line in said
        assert designed().verdict.digests["proof"] in said
        assert "Compare with the plan in policy.json" in said
    numbers = [line for line in (arm / CONTROLLER).read_text().splitlines() if ": 0." in line]
    assert len(numbers) == 3
    assert all("  # rad" in line for line in numbers)


def test_a_speed_has_thresholds_for_validators_and_no_joint(
    design: OutputTubeDesign, tmp_path: Path
) -> None:
    design.save(tmp_path)
    said = nlsid("export", tmp_path, "--out", tmp_path / "out")
    assert f"no {CONTROLLER}: no signal is in rad or m" in said
    content = yaml.safe_load((tmp_path / "out" / VALIDATOR).read_text())
    width = up(float(design.funnel.half_widths[0]))
    assert content["/**"]["ros__parameters"]["thresholds"] == {
        "over_velocity_ratio": 0.0,
        "over_velocity_offset": width,
        "velocity_deviation": width,
    }
    assert not (tmp_path / "out" / CONTROLLER).exists()
    table = (tmp_path / "out" / TABLE).read_text()
    assert table.splitlines()[1].split() == ["speed", f"{width:g}", f"{width:g}", "m/s"]
    assert "what the model simulates from the commands" in table
    assert "BEFORE USE: these numbers are about the model's simulation" in table
    first = (tmp_path / "out" / VALIDATOR).read_text().splitlines()[0]
    assert first.startswith("# BEFORE USE: these numbers are about the model's simulation")


def test_what_is_not_proved_has_no_tolerances(design: OutputTubeDesign, tmp_path: Path) -> None:
    design.save(tmp_path)
    funnel = files.load_document(tmp_path / FUNNEL)
    files.write_document(
        tmp_path / FUNNEL, funnel | {"tubes": [funnel["tubes"][0] | {"half_widths": [1e-3]}]}
    )
    with pytest.raises(CertificateRejected):
        tolerances(tmp_path)


@pytest.mark.parametrize(
    ("signals", "joints"),
    [
        (
            (("a", "rad", "/j:position[name=elbow]"), ("b", "rad", "/j:position[name=wrist]")),
            {"elbow", "wrist"},
        ),
        ((("a b", "rad", "/j:position[0]"), ("c: d #", "m", "/j:position[1]")), {"a_b", "c:_d_#"}),
        ((("a", "rad", "/j:position[name=x]"), ("b", "rad", "/k:position[name=x]")), {"a", "b"}),
    ],
)
@pytest.mark.parametrize("size", [2.0, 1e-5, 1e7, 0.12345678901])
def test_joints_are_called_as_in_the_messages_and_numbers_are_floats(
    arm: Path, signals: tuple[tuple[str, str, str], ...], joints: set[str], size: float
) -> None:
    found = tolerances(arm)
    number = text.above(Fraction(size))
    entries = tuple(
        replace(entry, signal=Signal(*signal), path=number, goal=number)
        for entry, signal in zip(found.entries, signals, strict=True)
    )
    content = yaml.safe_load(replace(found, entries=entries).controller())
    constraints = content["joint_trajectory_controller"]["ros__parameters"]["constraints"]
    assert set(constraints) == joints
    for values in constraints.values():
        assert values == {"trajectory": up(size), "goal": up(size)}
        assert all(type(value) is float for value in values.values()), "as the parameter is"


def test_the_widest_of_several_speeds_and_distances_is_the_threshold(arm: Path) -> None:
    found = tolerances(arm)
    first, second = found.entries
    made = [
        replace(first, signal=Signal(name, unit), path=path, goal=path)
        for name, unit, path in (
            ("x", "m", "0.1"),
            ("y", "m", "0.25"),
            ("vx", "m/s", "9"),
            ("vy", "m/s", "10"),
        )
    ]
    content = yaml.safe_load(replace(found, entries=(*made, second)).validator())
    assert content["/**"]["ros__parameters"]["thresholds"] == {
        "over_velocity_ratio": 0.0,
        "over_velocity_offset": 10.0,
        "velocity_deviation": 10.0,
        "distance_deviation": 0.25,
    }


@pytest.mark.parametrize(("path", "goal"), [("0", "1"), ("1", "0")])
def test_a_tolerance_of_nothing_is_refused(path: str, goal: str) -> None:
    """Zero would switch the controller's check off."""
    with pytest.raises(DataError, match=r"the tolerances of angle are .* no check at all"):
        Tolerance(Signal("angle", "rad"), path, goal)


def test_a_tube_of_several_outputs_has_a_row_for_each(tmp_path: Path) -> None:
    for file in (CORPUS / "tube" / "lasting_two_outputs").iterdir():
        shutil.copy(file, tmp_path / (PROOF if file.name == "claim.proof.json" else file.name))
    found = tolerances(tmp_path)
    funnel = files.load_document(tmp_path / FUNNEL)
    widths = np.min([tube["half_widths"] for tube in funnel["tubes"]], axis=0)
    assert [float(entry.path) for entry in found.entries] == [up(width) for width in widths]
    assert len(widths) == 2
    assert found.about == (
        "what the model simulates from the commands that were sent, not with the commands"
    )


def test_a_funnel_of_given_equations_is_refused_by_name(tmp_path: Path) -> None:
    for file in (CORPUS / "continuous_funnel" / CONTINUOUS).iterdir():
        shutil.copy(file, tmp_path / (PROOF if file.name == "claim.proof.json" else file.name))
    with pytest.raises(DataError, match="a funnel of given equations has sets of states"):
        tolerances(tmp_path)
