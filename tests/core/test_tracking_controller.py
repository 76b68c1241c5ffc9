"""The controller of a sampled funnel in the loop, and its runs replayed from a bag."""

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
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import BagError, DataError
from nlsid_core.models.state_map import StateModel
from nlsid_core.running.controller import Controller, Limits
from nlsid_core.running.reading import Status
from tests.tracked import PERIOD, STEPS, designed

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


def run(model: StateModel, controller: Controller, seed: int = 0) -> tuple[FloatArray, FloatArray]:
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
    y, u = run(made.model, controller)
    assert controller.ended == "the plan is over"
    assert len(y) == STEPS + 1
    monitor = made.monitor()
    said = [monitor.update(k * PERIOD, y[k], u[k]) for k in range(STEPS + 1)]
    assert {reading.status for reading in said} == {Status.INSIDE}


def test_a_robot_away_from_the_start_is_waited_for_and_then_given_up() -> None:
    controller = design().controller(LIMITS, 0.1)
    for k in range(10):
        controller.update(k * PERIOD, np.array([1.1, 0.0]))
    assert "not at the start of the plan after 0.1 s" in controller.ended


@pytest.mark.parametrize(
    ("t", "y", "said"),
    [(2 * PERIOD, [np.nan, 0.0], "state is"), (3.5 * PERIOD, [0.0, 0.0], "from when the next one")],
)
def test_a_sample_that_cannot_be_used_ends_the_run(t: float, y: list[float], said: str) -> None:
    controller = design().controller(LIMITS, 1.0)
    for k in range(2):
        controller.update(k * PERIOD, np.zeros(2))
    u = controller.u
    np.testing.assert_array_equal(controller.update(t, np.array(y)), u)
    assert said in controller.ended


def test_limits_that_cut_off_the_plan_are_refused_before_anything_moves() -> None:
    with pytest.raises(DataError, match=r"plan's input .* is beyond the limits"):
        design().controller(Limits(lowest=-0.1, highest=0.1, stop_rate=1.0), 1.0)


def test_limits_of_another_number_of_inputs_are_refused_before_anything_moves() -> None:
    two = Limits(lowest=np.array([-9.0, -9.0]), highest=9.0, stop_rate=1.0)
    with pytest.raises(DataError, match="limits for 2 inputs; the design has 1"):
        design().controller(two, 1.0)


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
    runs = [run(made.model, made.controller(LIMITS, 1.0), seed) for seed in range(2)]
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


def test_signals_on_several_topics_cannot_be_one_sample() -> None:
    with pytest.raises(BagError, match="/a, /b"):
        SignalVector.parse(["/a:data", "/b:data"])
