"""What a tube catches and tolerates: every number against an independent computation."""

import shutil
from dataclasses import replace
from decimal import ROUND_CEILING, Context, Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

from bags.designs.tolerances import CONTROLLER, TABLE, VALIDATOR, Tolerance, tolerances
from bags.monitoring.catching import (
    DELAY,
    LOST,
    SABOTAGES,
    UNTOUCHED,
    Catching,
    Caught,
    Row,
    Width,
    what_it_catches,
)
from bags.monitoring.replay import Replay
from bags.pictures import tables
from bags.pictures.catching_plots import catching as draw
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.data.calibration import calibration_trials
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTubeDesign
from nlsid_core.design.tube import energy, innovations
from nlsid_core.designs import FUNNEL, PROOF
from nlsid_core.errors import CertificateRejected, DataError
from nlsid_core.kernel import text
from nlsid_core.models import Signal
from nlsid_core.running.reading import Reading, Status
from tests.conftest import PERIOD, synthetic_dataset
from tests.core.kernel.mutations import CORPUS
from tests.core.kernel.tube_claims import dataset
from tests.core.kernel.tube_claims import design as follower
from tests.tracked import designed
from tests.verbs import nlsid

FACTOR = 1.5


@pytest.fixture(scope="module")
def held_back() -> Dataset:
    """Ten trials like those of training, recorded later."""
    many = synthetic_dataset(0.01, trials=16).trajectories
    return Dataset(many[6:])


@pytest.fixture(scope="module")
def found(design: OutputTubeDesign, train: Dataset, held_back: Dataset) -> Catching:
    return catches(design, train, held_back)


def catches(design: OutputTubeDesign, train: Dataset, held_back: Dataset) -> Catching:
    return what_it_catches(
        design,
        held_back=held_back,
        calibration=calibration_trials(train, least=72).calibration,
        ranges=np.array([np.ptp(np.concatenate([trial.y for trial in train]))]),
    )


def row(found: Catching, fault: str) -> Row:
    return next(row for row in found.rows if row.fault == fault)


def used(design: OutputTubeDesign, trial: Trajectory, y: FloatArray) -> FloatArray:
    """The largest part of a level that is used at every sample."""
    lasting, ending = design.funnel.tubes
    e = innovations(design.model, lasting.L[None], replace(trial, y=y), design.funnel.settling)
    for_ever, ends = (energy(e[:, 0], tube) / tube.level for tube in (lasting, ending))
    ends[ending.samples :] = 0.0
    return np.asarray(np.maximum(for_ever, ends))


def first_bad(design: OutputTubeDesign, trial: Trajectory, y: FloatArray) -> int | None:
    """The first judged sample after which more is used than is assumed."""
    beyond = used(design, trial, y) > 1.0
    return int(np.flatnonzero(beyond)[0]) if beyond.any() else None


@pytest.mark.parametrize("factor", [0.6, 0.8])
def test_caught_and_when_are_what_the_energy_of_the_innovations_says(
    design: OutputTubeDesign, found: Catching, held_back: Dataset, factor: float
) -> None:
    bad = [first_bad(design, trial, factor * trial.y) for trial in held_back]
    delays = [PERIOD * k for k in bad if k is not None]
    caught = row(found, f"sensor x {factor}").funnel
    assert caught.count == len(delays) > 0
    assert caught.outside + caught.violated == caught.count
    assert caught.after == pytest.approx(np.median(delays))


def test_untouched_trials_are_false_alarms_and_others_have_no_more(
    design: OutputTubeDesign, found: Catching, held_back: Dataset
) -> None:
    untouched = row(found, UNTOUCHED)
    assert untouched.fault == found.rows[0].fault
    exceeded = sum(first_bad(design, trial, trial.y) is not None for trial in held_back)
    assert untouched.funnel.violated == exceeded == 0
    assert all(other.count <= exceeded for other in untouched.others.values())
    assert found.trials == 10
    assert [row.fault for row in found.rows] == [UNTOUCHED, *(name for name, _ in SABOTAGES)]


def test_lost_samples_are_unknown_and_no_catch(found: Catching, held_back: Dataset) -> None:
    lost = row(found, f"{LOST} samples lost").funnel
    assert (lost.count, lost.unjudged) == (0, len(held_back))
    assert np.isnan(lost.after)


def test_detectors_are_named_beside_each_sabotage_and_catch_what_they_should(
    found: Catching,
) -> None:
    assert set(found.rows[0].others) == {"CUSUM", "3σ", "box"}
    assert row(found, "sensor x 0.6").others["CUSUM"].count > 0
    assert row(found, "sensor x 0.6").others["box"].count > 0


def test_copies_are_what_their_names_say(design: OutputTubeDesign, held_back: Dataset) -> None:
    trial, faults = held_back.trajectories[0], dict(SABOTAGES)
    made = {name: fault(trial, np.array([2.0]), design.model) for name, fault in faults.items()}
    y = trial.y
    np.testing.assert_array_equal(made["stuck at first value"], np.full_like(y, y[0, 0]))
    np.testing.assert_array_equal(made["sensor x 0.6"], 0.6 * y)
    np.testing.assert_array_equal(made["bias, 10 % of range"], y + 0.2)
    late = made[f"late by {DELAY} samples"]
    np.testing.assert_array_equal(late[DELAY:], y[:-DELAY])
    np.testing.assert_array_equal(late[:DELAY], np.full((DELAY, 1), y[0, 0]))
    kept = y.copy()
    kept[len(y) // 2 : len(y) // 2 + LOST] = np.nan
    np.testing.assert_array_equal(made[f"{LOST} samples lost"], kept)


def test_a_weak_actuator_is_what_the_model_makes_of_less_input(design: OutputTubeDesign) -> None:
    """On a trial that the model itself made, it is the model's own response to 0.8 u."""
    u = np.repeat(np.array([0.0, 0.6, 0.2, 0.5]), 20)
    full, weak = (_simulated(design, gain * u, u) for gain in (1.0, 0.8))
    trial = Trajectory(t=PERIOD * np.arange(len(u)), y=full, u=u)
    copy = dict(SABOTAGES)["actuator x 0.8"](trial, np.ones(1), design.model)
    np.testing.assert_allclose(copy[:, 0], weak, atol=1e-12)


def _simulated(design: OutputTubeDesign, applied: FloatArray, first: FloatArray) -> FloatArray:
    """By the difference equation: n zeros under the full input, then the model under `applied`."""
    model, n = design.model, len(design.model)
    y, u = np.zeros(len(applied)), applied.copy()
    u[:n] = first[:n]
    for t in range(n, len(y)):
        y[t] = model.a @ y[t - n : t][::-1] + model.b @ u[t - n : t + 1][::-1] + model.c
    return y


def test_widths_and_shares_are_measured_on_the_calibration_trials(
    design: OutputTubeDesign, train: Dataset, found: Catching
) -> None:
    (width,) = found.widths
    assert width.half_width == design.funnel.half_widths[0]
    assert width.share == width.half_width / np.ptp(np.concatenate([trial.y for trial in train]))
    assert width.said.endswith(" m/s")
    for name, share in found.shares:
        trial = train.select([name]).trajectories[0]
        assert share == pytest.approx(used(design, trial, trial.y).max(), rel=1e-8)
    assert [share for _, share in found.shares] == sorted((s for _, s in found.shares))[::-1]
    n = len(design.model)
    errors = []
    for name, _ in found.shares:
        trial = train.select([name]).trajectories[0]
        y = trial.y[:, 0].copy()
        for t in range(n, len(y)):
            past = y[t - n : t][::-1], trial.u[t - n : t + 1, 0][::-1]
            y[t] = design.model.a @ past[0] + design.model.b @ past[1] + design.model.c
        errors.append(np.abs(trial.y[:, 0] - y)[n:].max())
    assert width.error == pytest.approx(max(errors), rel=1e-9)


def wide(found: Catching, share: float, error: float, shares: tuple[float, ...]) -> Catching:
    width = Width("speed", "m/s", share, 1.0, error)
    named = tuple((f"trial {i}", part) for i, part in enumerate(shares))
    return replace(found, widths=(width,), shares=named)


def test_a_wide_tube_is_warned_of_with_its_cause(found: Catching) -> None:
    assert wide(found, 0.5, 0.1, (0.4,)).warnings() == []
    (poor,) = wide(found, 0.5625, 0.375, (0.44, 0.05, 0.04)).warnings()
    assert "is 0.5625 of its range, 1 m/s; more than 0.5 says little" in poor
    assert "trial 0 sets the level: it uses 8.8 times as much" in poor
    assert "median of 3 calibration trials, trial 1 as the next 1 times" in poor
    assert "off by up to 0.375 m/s" in poor
    assert "0.5625 m/s with the safety factor" in poor
    assert "try more lags, another class" in poor
    (loose,) = wide(found, 3.0, 0.1, (0.4, 0.3, 0.3)).warnings()
    assert "the half-width is 20 times that" in loose
    assert loose.endswith("leaves less in its residual")
    constant = replace(found, widths=(Width("speed", "m/s", 0.1, 0.0, 0.05),))
    assert "is inf of its range" in constant.warnings()[0]


def test_a_tube_beside_which_trials_hardly_move_is_warned_of(
    found: Catching, train: Dataset
) -> None:
    moves = [np.ptp(train.select([name]).trajectories[0].y) for name, _ in found.shares]
    assert found.widths[0].moves == pytest.approx(np.median(moves))
    assert found.still == []
    motor = Width("speed", "rad/s", 20.5, 52.4, 3.7, moves=28.0)
    [said] = replace(found, widths=(motor,)).still
    assert "the half-width of speed is 20.5 rad/s, and within a calibration trial speed" in said
    assert "moves by 28 rad/s (the median)" in said
    assert replace(found, widths=(replace(motor, moves=42.0),)).still == []
    assert replace(found, widths=(replace(motor, range=40.0),)).still == [], "that is said before"


def test_the_table_colours_the_faults_that_another_detector_catches_more_often(
    found: Catching,
) -> None:
    worse = Row(
        "made up",
        Caught(outside=1, violated=2, unjudged=3, after=0.25, alarmed=4),
        {"CUSUM": Caught(violated=9, after=0.5), "3σ": Caught(), "box": Caught()},
    )
    refused = Row("refused", Caught(), {}, "no such input")
    table = tables.catching_table(replace(found, rows=(*found.rows, worse, refused)))
    console = Console(width=80, record=True, file=None, force_terminal=False)
    with console.capture() as said:
        console.print(table)
    line = next(line for line in said.get().splitlines() if "made up" in line)
    assert line.split() == [
        "made",
        "up",
        "1",
        "2",
        "4",
        "3",
        "0.25",
        "9",
        "0.50",
        "0",
        "-",
        "0",
        "-",
    ]
    assert table.rows[-2].style == "dark_orange3"
    assert table.rows[0].style == ""
    assert (
        next(line for line in said.get().splitlines() if "refused" in line).split()[1:] == ["-"] * 8
    )
    with console.capture() as said:
        tables.say_catching(console, replace(found, rows=(*found.rows, refused)))
    assert "refused was not tried: no such input" in said.get()


@pytest.mark.pictures
def test_the_picture_has_a_bar_for_every_fault_that_is_seen_and_every_detector(
    found: Catching,
) -> None:
    figure = draw(found)
    (errors,), (caught,) = (part.axes for part in figure.subfigs)
    assert len(errors.lines) == found.trials + 2
    seen = [row for row in found.rows[1:] if row.fault != "5 samples lost"]
    assert [label.get_text() for label in caught.get_yticklabels()] == [r.fault for r in seen]
    assert len(caught.patches) == len(seen) * (1 + 3)
    bars: Any = zip(caught.patches, seen, strict=False)
    assert all(bar.get_width() == row.funnel.after for bar, row in bars)


@pytest.mark.pictures
def test_a_tube_that_follows_the_commands_says_and_draws_how() -> None:
    """Half-widths are those of the readings: their mean, least and most on calibration trials."""
    made = follower("following")
    model = made.model
    calibration, held_back = dataset(model, 100), dataset(model, 200, 3)
    ranges = np.ptp(np.concatenate([trial.y for trial in calibration]), axis=0)
    found = what_it_catches(
        made,
        held_back=held_back,
        calibration=calibration,
        ranges=ranges,
    )
    level, settling = made.funnel.tubes[0].follows, made.funnel.settling
    assert level is not None
    g = np.concatenate([level.along(trial.u)[settling:] for trial in calibration])
    following, headline = (tube.half_widths[0] for tube in made.funnel.tubes)
    expected = np.minimum(following * np.sqrt(g), headline)
    width = found.widths[0]
    assert (width.half_width, width.least, width.most) == pytest.approx(
        (expected.mean(), expected.min(), expected.max()), rel=1e-6
    )
    assert width.said == "0.146", "it is as wide always here: no average is said"
    assert found.beyond == []
    narrow = replace(found, widths=(replace(width, range=0.9 * float(expected.max())),))
    assert "where the commands change most, beyond its range" in narrow.beyond[0]
    (errors,), _ = (part.axes for part in draw(found).subfigs)
    assert len(errors.collections) == found.trials


@pytest.mark.slow
def test_a_sensors_fault_is_put_into_the_output_in_which_it_is_caught_least() -> None:
    """Of two outputs; what the monitor says of each alone is counted here by itself."""
    made = follower("two_outputs")
    calibration, held_back = dataset(made.model, 100), dataset(made.model, 200, 4)
    ranges = np.ptp(np.concatenate([trial.y for trial in calibration]), axis=0)
    monitor = made.monitor()
    found = what_it_catches(
        made,
        held_back=held_back,
        calibration=calibration,
        ranges=ranges,
    )
    counts = []
    for output in range(2):
        caught = 0
        for trial in held_back:
            y = trial.y.copy()
            y[:, output] *= 0.6
            monitor.restart()
            rows = zip(trial.t.tolist(), y, trial.u, strict=True)
            said = [monitor.update(t, now, u) for t, now, u in rows]
            caught += any(
                r.alarm or r.status.value in ("outside", "assumption violated") for r in said
            )
        counts.append(caught)
    scaled = row(found, "sensor x 0.6")
    assert scaled.funnel.count == min(counts)
    names = held_back.trajectories[0].y_names
    assert scaled.output in {
        name for name, n in zip(names, counts, strict=True) if n == min(counts)
    }
    assert {row.output for row in found.rows if row.fault.startswith(("act", "5"))} == {""}


def test_an_alarm_before_the_fault_is_a_false_one_and_catches_nothing(
    design: OutputTubeDesign, train: Dataset, held_back: Dataset
) -> None:
    """Trials whose sensor jumps at their beginning, long before the sabotage."""
    jumped = []
    for trial in held_back:
        y = trial.y.copy()
        y[8] += 1.0
        jumped.append(replace(trial, y=y))
    found = catches(design, train, Dataset(tuple(jumped)))
    assert row(found, UNTOUCHED).funnel.count == len(jumped)
    zero = [r for r in found.rows if r.fault != UNTOUCHED]
    for caught in (c for r in zero for c in (r.funnel, *r.others.values())):
        assert not caught.after < 0.0
    console = Console(record=True, width=100)
    tables.say_catching(console, found)
    said = " ".join(console.export_text().split())
    assert f"warning: {len(jumped)} of {len(jumped)} held-back trials, nothing put into" in said


def test_a_tube_wider_than_what_was_measured_is_said_with_its_share_of_the_samples() -> None:
    def replay(widths: list[float], low: float = 0.0) -> Replay:
        readings = tuple(
            Reading(
                0.1 * k, Status.INSIDE, 0.9, measured=([low, 1.0][k % 2],), half_widths=(width,)
            )
            for k, width in enumerate(widths)
        )
        return Replay("drive", readings, "speed", "m/s", 0.0, 0.1)

    said = replay([0.5] * 6 + [1.5] * 4).said_wide
    assert said.startswith("in 40 % of the samples judged the half-width is more than all that")
    assert "was measured here, 1 m/s: the tube says nothing there" in said
    assert replay([0.1] * 10, low=0.95).said_wide == "", "a tenth of a speed that hardly changes"
    assert "than all that was measured here, 3 m/s" in replay([4.0] * 10, low=-2.0).said_wide
    assert replay([0.5] * 10).said_wide == replay([]).said_wide == ""


# -- Tolerances: every number is the proof's, rounded up, in a file that its reader parses

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
    tolerances(arm).write(arm)
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
    assert {path.name for path in written} == {CONTROLLER, TABLE}
    for path in written:
        said = path.read_text()
        for line in str(designed().verdict).splitlines():
            assert line in said
        assert designed().verdict.digests["proof"] in said
        assert "Compare with the plan in policy.json" in said
    assert "rounded up: angle in rad, rate in rad/s" in (arm / CONTROLLER).read_text()


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
    content = yaml.safe_load(yaml.safe_dump(replace(found, entries=entries).controller()))
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
    content = replace(found, entries=(*made, second)).validator()
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
