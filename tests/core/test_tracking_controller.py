"""Sampled funnels at run time: the controller in the loop, the monitor, and runs in a bag."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.chain.joint_bags import COMMANDS, JOINTS, STATES, _make
from bags.designs.bundle import Bundle
from bags.monitoring.announcement import Run
from bags.monitoring.replay import announced_runs, replay_messages
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from bags.signals.message_reader import SignalVector
from nlsid import Dataset, Status, Trajectory
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.sampled.design import assume
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError, DataError
from nlsid_core.models.state_map import StateModel
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.reading import Level, Reading
from tests.tracked import PERIOD, STEPS, designed, run, tracked

STRING = "std_msgs/msg/String"
LIMITS = Limits(lowest=-9.0, highest=9.0, stop_rate=50.0)
NOISE = np.array([1e-4, 1e-3])


def design() -> AnyDesign:
    """The funnel of `tests.tracked` as the nodes read it, its signals on joint topics."""
    made = designed()
    documents = {role: getattr(made, role).document() for role in ("model", "policy", "funnel")}
    for kind, names in (("x", ("position[0]", "velocity[0]")), ("u", ("effort[0]",))):
        topic = STATES if kind == "x" else COMMANDS
        for signal, name in zip(documents["model"][kind], names, strict=True):
            signal["path"] = f"{topic}:{name}"
    digest = files.digest(documents["model"])
    documents["policy"]["model"] = documents["funnel"]["model"] = digest
    documents["funnel"]["policy"] = files.digest(documents["policy"])
    return Bundle({name: files.encode(document) for name, document in documents.items()}).design()


def engaged(
    model: StateModel, controller: Controller, seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """States and inputs of the model under the controller, until it ends."""
    rng = np.random.default_rng(seed)
    x: FloatArray = np.zeros(2)
    y, u = [], []
    for k in range(STEPS + 50):
        y.append(x + NOISE * rng.standard_normal(2))
        controller.update(k * PERIOD, y[-1])
        u.append(controller.u)
        if controller.ended:
            break
        x = model(x, u[-1])
    return np.array(y), np.array(u)


def test_every_input_is_the_policys_and_the_run_stays_inside() -> None:
    made = design()
    controller = made.controller(LIMITS, 1.0)
    y, u = engaged(made.model, controller)
    assert controller.ended == "the plan is over"
    assert len(y) == STEPS + 1
    monitor = made.monitor()
    said = [monitor.update(k * PERIOD, y[k], u[k]) for k in range(STEPS + 1)]
    assert {reading.status for reading in said} == {Status.INSIDE}


def test_an_input_that_the_limits_would_cut_is_not_sent_and_ends_the_run() -> None:
    made = design()
    highest = float(np.abs(made.policy.u).max())
    controller = made.controller(Limits(lowest=-9.0, highest=highest, stop_rate=1.0), 1.0)
    k, x = int(np.argmax(made.policy.u)), made.policy.x
    for i in range(k):
        controller.update(i * PERIOD, x[i])
    before = controller.u
    np.testing.assert_array_equal(controller.update(k * PERIOD, x[k] - [0.02, 0.0]), before)
    assert "is not proved" in controller.ended


@pytest.mark.parametrize("heard", [-3, 5, -80])
def test_runs_that_follow_each_other_in_one_bag_are_each_replayed_from_their_start(
    tmp_path: Path, heard: int
) -> None:
    """An announcement comes `heard` samples after its start: also late, or in the run before."""
    made = design()
    runs = [engaged(made.model, made.controller(LIMITS, 1.0), seed) for seed in range(2)]
    digest = files.digest(made.funnel.document())
    empty, period_ns = np.zeros(0), round(PERIOD * 1e9)
    events: list[tuple[int, str, str, object]] = []
    for number, (y, u) in enumerate(runs):
        start_ns = 10**12 + 2 * number * 10**9
        text = files.encode(Run(start_ns, digest).document()).decode()
        message = _make(STRING, text)
        events.append(
            (start_ns + heard * period_ns - 1, "/tracking_controller/run", STRING, message)
        )
        waiting = [(y[0], np.zeros(1))] * 3
        for k, (state, effort) in enumerate([*waiting, *zip(y, u, strict=True)]):
            stamp_ns = start_ns + (k - 3) * period_ns
            stamp = _make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
            header = _make("std_msgs/msg/Header", stamp, "")
            states = _make(JOINTS, header, ["joint"], state[:1], state[1:], empty)
            efforts = _make(JOINTS, header, ["joint"], empty, empty, effort)
            events += [(stamp_ns, STATES, JOINTS, states), (stamp_ns, COMMANDS, JOINTS, efforts)]
    with BagWriter(tmp_path / "bag") as writer:
        for log_ns, topic, kind, content in sorted(events, key=lambda event: event[0]):
            data = bytes(standard_types().serialize_cdr(content, kind, little_endian=True))
            writer.write(topic, kind, data, log_time_ns=log_ns, publish_time_ns=log_ns)
    assert len(announced_runs(made, tmp_path / "bag")) == 2
    stamped = replay_messages(made, tmp_path / "bag")
    judged = [e for e in stamped if e.reading.status is not Status.UNKNOWN]
    expected = []
    for y, u in runs:
        monitor = made.monitor()
        expected += [monitor.update(k * PERIOD, y[k], u[k]).margin for k in range(len(y))]
    assert [e.reading.margin for e in judged] == expected
    assert {e.reading.status for e in judged} == {Status.INSIDE}


@pytest.mark.parametrize(
    ("paths", "says"),
    [
        (["/a:data", "/b:data"], "/a, /b"),
        (
            ["/a:data[0]", "/a:data[1]|derivative(0.2 s)"],
            r"derivative\(0.2 s\) makes",
        ),
        (["/a:data|to(deg)"], "makes other numbers"),
        (["/a:data|lag(0.1 s)"], "makes other numbers"),
        (["/a:data|linear(0.1 s)"], "makes other numbers"),
    ],
)
def test_what_is_no_number_in_a_message_is_not_driven(paths: list[str], says: str) -> None:
    with pytest.raises(BagError, match=says):
        SignalVector.parse(paths, "hold")


# -- The live side of a sampled funnel: verdicts, the assumption, levels, missing samples


def readings(recorded: Trajectory) -> list[Reading]:
    """What the monitor says of every sample."""
    design = designed()
    monitor = design.monitor()
    return [
        monitor.update(float(t), y, u)
        for t, y, u in zip(recorded.t, recorded.y, recorded.u, strict=True)
    ]


def test_a_run_as_it_should_be_is_inside_and_ends_in_the_goal() -> None:
    result = readings(run())
    assert {r.status for r in result} == {Status.INSIDE}
    assert all(0 < r.margin <= 1 and 0 <= r.assumption < 1 for r in result)
    assert result[0].level is Level.TUBE
    assert result[-1].level is Level.GOAL


def test_a_kick_breaks_the_assumption_before_the_tube_is_left() -> None:
    result = readings(run(kick=np.array([0.0, 0.3])))
    flagged = next(k for k, r in enumerate(result) if r.status is not Status.INSIDE)
    assert flagged <= 11
    assert result[flagged].status is Status.ASSUMPTION_VIOLATED
    assert "disturbance response" in result[flagged].reason
    assert result[flagged].assumption > 1


def test_a_large_kick_is_outside_and_the_reason_names_the_assumption() -> None:
    result = readings(run(kick=np.array([0.0, 40.0])))
    outside = next(r for r in result if r.status is Status.OUTSIDE)
    assert outside.margin < 0
    assert outside.time_to_exit == 0
    assert "disturbance" in outside.reason
    assert outside.level in (Level.INLET, Level.NONE)


def test_a_growing_deviation_counts_down_to_the_exit() -> None:
    result = readings(run(kick=np.array([0.0, 3.0])))
    falling = [r.time_to_exit for r in result[9:12]]
    assert all(math.isfinite(value) and value >= 0 for value in falling)


def test_a_start_outside_the_inlet_is_flagged_at_once() -> None:
    design = designed()
    far = design.policy.x[0] + np.linalg.solve(
        design.funnel.S[0], [1.5 * design.funnel.radius[0], 0.0]
    )
    assert readings(run(start=far))[0].status is Status.OUTSIDE


def test_the_assumption_is_the_largest_commissioning_run_times_the_safety_factor() -> None:
    base = tracked()
    runs = Dataset(tuple(run(seed=seed) for seed in range(3)))
    assumption = assume(base.model, base.policy, base.feedback, runs, safety_factor=2.0)
    assert assumption.bound >= 2.0 * assumption.measured > 0
    assert [name for name, _ in assumption.measured_on] == ["run_0", "run_1", "run_2"]
    short = replace(runs.trajectories[0], t=np.arange(5.0), y=np.zeros((5, 2)), u=np.zeros(5))
    with pytest.raises(DataError, match="steps"):
        assume(base.model, base.policy, base.feedback, Dataset((short,)))
