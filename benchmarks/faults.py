"""What goes wrong on a robot, done to monitor and controller over DDS: expected and seen verdicts.

python -m benchmarks.faults [--json] [--only TEXT]

The F1TENTH car's funnel; this process is the robot where a fault is in its messages, the simulated
plant is where nodes are killed or held. `silent_inside` counts the faults after which the monitor
went on saying inside, `moved_unproved` those after which the controller moved the robot on a design
that is not proved, that it had refused, or that nobody watched although it was to be watched.
`hung`: those after which a node that was not killed said nothing more, or did not end.
"""

import json
import math
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs.bundle import MAX_BYTES, Bundle
from bags.designs.documents import FUNNEL, MODEL
from bags.monitoring.announcement import UNANNOUNCED, WAITING
from bags.samples import f1tenth
from benchmarks.machine import describe, parser
from benchmarks.processes import busy, isolate, node, python
from nlsid_core import files
from nlsid_core.design import ContinuousTracking, design, integrate_nominal
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import NlsidError
from nlsid_core.progress import silent
from nlsid_ros import qos

PERIOD_NS = 25_000_000
GOOD, BAD = 12, 90  # samples before a fault, and at most under it
STALE = 0.5  # s of patience of the nodes in a loop,
PATIENT = 2.0  # and where this process is the robot, on a busy machine
TRIES = 5  # of a fault before which a machine that does other things left the robot unjudged
PATIENCE = 120.0  # s for nodes to come up, on a machine that does other things too
VERDICT = 6.0  # s for a verdict
MONITOR, CONTROLLER = "funnel_monitor", "tracking_controller"


@dataclass(frozen=True)
class Seen:
    """One fault: what had to be said, what was, and after how many s (nan: never)."""

    fault: str
    expected: str
    seen: str
    seconds: float
    as_expected: bool
    silent_inside: bool = False
    moved_unproved: bool = False
    hung: bool = False


@dataclass
class Said:
    """What a node said last, and all it said, with the time."""

    level: bytes = DiagnosticStatus.STALE
    text: str = ""
    lines: list[tuple[float, bytes, str]] = field(default_factory=list)


class Rig:
    """The robot: signals, design and clock out, verdicts and commands in."""

    def __init__(self, robot: Node, executor: SingleThreadedExecutor, *, drives: bool) -> None:
        self.node, self._executor = robot, executor
        self.said: dict[str, Said] = {}
        self.commands: list[float] = []
        if drives:
            self.odom = robot.create_publisher(Odometry, "/odom", qos.STREAM)
            self.command = robot.create_publisher(TwistStamped, "/cmd_vel", qos.STREAM)
            self.design = robot.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
            self.clock = robot.create_publisher(Clock, "/clock", qos.STREAM)
        robot.create_subscription(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)
        robot.create_subscription(TwistStamped, "/cmd_vel", self._hear_command, qos.STREAM)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            said = self.said.setdefault(status.name.partition(":")[0], Said())
            said.level, said.text = status.level, status.message
            said.lines.append((time.monotonic(), status.level, status.message))

    def _hear_command(self, message: TwistStamped) -> None:
        self.commands.append(message.twist.linear.x)

    def spin(self, seconds: float) -> None:
        """Hear what comes for so long."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def until(self, condition: Callable[[], Any], patience: float = PATIENCE) -> bool:
        """Whether the condition held within `patience` s."""
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.02)
        return True

    def need(self, what: str, condition: Callable[[], Any]) -> None:
        """`until`, NlsidError if it did not hold."""
        if not self.until(condition):
            raise NlsidError(f"waited {PATIENCE:g} s for {what}, in vain")

    def has_said(self, name: str, pattern: str, since: float = 0.0) -> float:
        """When a node first said a text like it, nan if it has not."""
        lines = self.said.get(name, Said()).lines
        return next(
            (t for t, _, text in lines if t >= since and re.search(pattern, text)), math.nan
        )

    def is_silent(self, name: str) -> bool:
        """Whether a node says nothing more, not even what it repeats every second."""
        now = time.monotonic()
        return not self.until(lambda: self.has_said(name, "", now) >= 0)

    def call(self, service: str) -> Trigger.Response:
        """The answer of a std_srvs/Trigger."""
        client = self.node.create_client(Trigger, service)
        self.need(service, client.service_is_ready)
        answer = client.call_async(Trigger.Request())
        self.need(f"the answer of {service}", answer.done)
        self.node.destroy_client(client)
        response: Trigger.Response = answer.result()
        return response

    def sample(
        self,
        stamp_ns: int,
        *,
        speed: float = 0.0,
        command: float | None = 0.0,
        frame: str = "odom",
        clock_ns: int | None = None,
        command_ns: int | None = None,
    ) -> None:
        """One command, with the state's stamp or its own, and one state."""
        state, sent = Odometry(), TwistStamped()
        for message, of_ns in ((state, None), (sent, command_ns)):
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(stamp_ns if of_ns is None else of_ns, 10**9)
        state.header.frame_id, state.twist.twist.linear.x = frame, speed
        if clock_ns is not None:
            now = Clock()
            now.clock.sec, now.clock.nanosec = divmod(clock_ns, 10**9)
            self.clock.publish(now)
        if command is not None:
            sent.twist.linear.x = command
            self.command.publish(sent)
        self.odom.publish(state)


Act = Callable[[Rig, int, int], None]  # sample k, whose stamp would be the second number (ns)


def silence(_rig: Rig, _k: int, _stamp_ns: int) -> None:
    """Nothing comes."""


def drop(rig: Rig, k: int, stamp_ns: int) -> None:
    """One sample is lost."""
    if k != GOOD:
        rig.sample(stamp_ns)


def swap(rig: Rig, k: int, stamp_ns: int) -> None:
    """Pairs come in the wrong order."""
    rig.sample(stamp_ns + PERIOD_NS * (1 if (k - GOOD) % 2 == 0 else -1))


def duplicate(rig: Rig, _k: int, stamp_ns: int) -> None:
    """Each sample comes twice, the same."""
    rig.sample(stamp_ns)
    rig.sample(stamp_ns)


def contradict(rig: Rig, _k: int, stamp_ns: int) -> None:
    """Each sample comes twice, with another value."""
    rig.sample(stamp_ns)
    rig.sample(stamp_ns, speed=0.001)


def intrude(rig: Rig, _k: int, stamp_ns: int) -> None:
    """Another car's samples between this one's."""
    rig.sample(stamp_ns)
    rig.sample(stamp_ns + PERIOD_NS // 2, speed=0.2)


def flood(count: int) -> Act:
    """`count` states a period with stamps between the samples."""

    def act(rig: Rig, _k: int, stamp_ns: int) -> None:
        rig.sample(stamp_ns)
        for i in range(1, count):
            rig.sample(stamp_ns + i * PERIOD_NS // count, command=None)

    return act


def every(**given: Any) -> Act:
    """Every sample is like this."""
    return lambda rig, _k, stamp_ns: rig.sample(stamp_ns, **given)


def shifted(seconds: float) -> Act:
    """Stamps jump by so much."""
    return lambda rig, _k, stamp_ns: rig.sample(stamp_ns + round(seconds * 1e9))


def commanded(seconds: float) -> Act:
    """Commands are stamped so much from now; without a number, with 0."""

    def act(rig: Rig, _k: int, stamp_ns: int) -> None:
        of_ns = 0 if math.isnan(seconds) else stamp_ns + round(seconds * 1e9)
        rig.sample(stamp_ns, command_ns=of_ns)

    return act


def stretched(factor: float) -> Act:
    """Stamps go on at another rate."""
    return lambda rig, k, stamp_ns: rig.sample(
        stamp_ns + round((k - GOOD + 1) * PERIOD_NS * (factor - 1.0))
    )


INSIDE = "^inside$"
MESSAGES: list[tuple[str, Act, str]] = [
    ("no fault", every(), INSIDE),
    ("state NaN", every(speed=math.nan), r"unknown: no speed at .* \(missing, or not a number\)"),
    ("state infinite", every(speed=math.inf), r"unknown: no speed at .* \(it is inf\)"),
    ("state minus infinite", every(speed=-math.inf), r"unknown: no speed at .* \(it is -inf\)"),
    ("state 1e300", every(speed=1e300), "^outside"),
    ("state 1 m/s", every(speed=1.0), "^outside"),
    ("command NaN", every(command=math.nan), "^unknown"),
    ("silence", silence, "unknown: no speed for"),
    ("one sample dropped", drop, "unknown: the sample is lost"),
    ("pairs reordered", swap, "^unknown"),
    ("duplicates", duplicate, INSIDE),
    ("conflicting duplicates", contradict, "unknown: speed has two values"),
    ("another car between", intrude, "^unknown"),
    ("another frame", every(frame="map"), "unknown: the response is in frame 'map'"),
    ("flood at 1 kHz", flood(25), "^unknown"),
    ("flood at 5 kHz", flood(125), "^unknown"),
    ("stamps early by half a period", shifted(-0.0125), "^unknown"),
    ("stamps late by half a period", shifted(0.0125), "^unknown"),
    ("stamps jump back 1 s", shifted(-1.0), "^unknown"),
    ("stamps jump ahead 1 s", shifted(1.0), "^unknown"),
    ("stamps jump back 1 h", shifted(-3600.0), "^unknown"),
    ("stamps jump ahead 1 h", shifted(3600.0), "^unknown"),
    ("33 Hz", stretched(40.0 / 33.0), "^unknown"),
    ("50 Hz", stretched(40.0 / 50.0), "^unknown"),
    ("a clock 2.4 % slow", stretched(1.024), "unknown: samples come every 0.0"),
    ("a clock 2.4 % fast", stretched(0.976), "unknown: samples come every 0.0"),
    ("commands stamped 0", commanded(math.nan), "^unknown"),
    ("commands stamped an hour ahead", commanded(3600.0), "^unknown"),
    ("commands stamped an hour ago", commanded(-3600.0), "^unknown"),
]


def message_faults(rig: Rig, only: str) -> Iterator[Seen]:
    """Faults in what the robot sends, to one monitor that is restarted."""
    if not any(only in name for name, *_ in MESSAGES):
        return
    with python(*node(MONITOR, stale_after=PATIENT, command_wait=0.1)):
        rig.need("the monitor", lambda: rig.odom.get_subscription_count() >= 1)
        rig.need("its commands", lambda: rig.command.get_subscription_count() >= 2)
        for name, act, expected in MESSAGES:
            if only not in name:
                continue
            for left in reversed(range(TRIES)):
                rig.call(f"/{MONITOR}/restart")
                try:
                    seen = _fed(rig, name, act, expected)
                    break
                except NlsidError:
                    if not left:
                        raise
            yield seen


def _fed(rig: Rig, name: str, act: Act, expected: str) -> Seen:
    """Good samples until they are inside, then the fault until it is named or time is over."""
    rig.said.clear()
    start_ns, began = time.time_ns(), time.monotonic()
    faulty = math.nan
    for k in range(GOOD + BAD):
        stamp_ns = start_ns + k * PERIOD_NS
        if k < GOOD:
            rig.sample(stamp_ns)
        else:
            if k == GOOD and not rig.has_said(MONITOR, INSIDE) >= 0:
                raise NlsidError(f"{name}: not inside before the fault: {rig.said}")
            faulty = time.monotonic() if k == GOOD else faulty
            act(rig, k, stamp_ns)
        rig.spin(began + (k + 1) * PERIOD_NS * 1e-9 - time.monotonic())
    return _judged(rig, name, expected, faulty)


def _judged(rig: Rig, name: str, expected: str, since: float) -> Seen:
    """What the monitor said of it."""
    if expected == INSIDE:
        rig.spin(0.1)
        lines = [text for t, _, text in rig.said[MONITOR].lines if t >= since]
        same = all(re.search(INSIDE, text) for text in lines)
        hung = rig.is_silent(MONITOR)
        return Seen(name, expected, (lines or ["inside"])[-1], 0.0, same, hung=hung)
    rig.until(lambda: rig.has_said(MONITOR, expected, since) >= 0, VERDICT)
    at = rig.has_said(MONITOR, expected, since)
    said = rig.said.get(MONITOR, Said())
    text = next((text for t, _, text in said.lines if t == at), said.text)
    silent = all(level == DiagnosticStatus.OK for heard, level, _ in said.lines if heard >= since)
    hung = rig.is_silent(MONITOR)
    return Seen(name, expected, text, at - since, at >= since, silent_inside=silent, hung=hung)


def verdict_faults(rig: Rig, good: Bundle, other: Bundle, only: str) -> Iterator[Seen]:
    """Verdicts of another funnel, of no run or of two nodes, to a controller that requires them."""
    digest = good.digest
    cases = [
        ("verdicts of no funnel", [""], "judges a funnel that it does not name"),
        ("verdicts of another funnel", [f"{other.digest} {WAITING}"], "judges the funnel sha256:"),
        ("verdicts of no run", [f"{digest} {UNANNOUNCED}"], "judges no run"),
        ("verdicts of another run", [f"{digest} 7"], "has judged nothing"),
        ("no verdicts", [], "nobody publishes"),
        ("verdicts of two nodes", [f"{digest} {WAITING}"] * 2, "2 nodes publish"),
    ]
    required = {"stale_after": PATIENT, "require_monitor": True, "monitor_patience": STALE}
    rig.said.clear()
    rig.node.destroy_publisher(rig.command)
    chosen = [case for case in cases if only in case[0]]
    if chosen:
        with python(*node(CONTROLLER, highest=0.4, **required)):
            rig.need("the controller", lambda: rig.has_said(CONTROLLER, "^idle$") >= 0)
            for name, judging, expected in chosen:
                yield _watched_by(rig, name, judging, expected)
    name, expected = "a monitor of a wider funnel", f"judges the funnel {other.digest}"
    if only not in name:
        return
    wide = rig.node.create_publisher(String, "/wide/design", qos.DOCUMENT)
    wide.publish(String(data=other.text()))
    watching = {"nominal": "profile", "controller": CONTROLLER, "source": "/wide"}
    rig.said.clear()
    with python(*node(CONTROLLER, highest=0.4, **required)), python(*node(MONITOR, **watching)):
        rig.need("the controller", lambda: rig.has_said(CONTROLLER, "^idle$") >= 0)
        rig.need("the monitor", lambda: rig.has_said(MONITOR, "no speed yet") >= 0)
        rig.spin(2.0)  # on a busy machine the controller learns late of who judges
        yield _watched_by(rig, name, [], expected)


def _watched_by(rig: Rig, name: str, judging: list[str], expected: str) -> Seen:
    """A run that is begun, and a verdict of each of `judging` with every sample of it."""
    topic, since = f"/{MONITOR}/margin", time.monotonic()
    rig.commands.clear()
    made = [rig.node.create_publisher(JointState, topic, qos.STREAM) for _ in judging]
    rig.need("the verdicts", lambda: all(p.get_subscription_count() for p in made))
    rig.spin(0.5)  # the controller may know of them later
    answer = rig.call(f"/{CONTROLLER}/start")
    for _ in range(BAD if answer.success else 0):
        stamp_ns = time.time_ns()
        rig.sample(stamp_ns, command=None)
        for publisher, text in zip(made, judging, strict=True):
            said = JointState(name=["margin"], position=[0.5])
            said.header.stamp.sec, said.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            said.header.frame_id = text
            publisher.publish(said)
        rig.spin(PERIOD_NS * 1e-9)
    for publisher in made:
        rig.node.destroy_publisher(publisher)
    heard = rig.has_said(CONTROLLER, expected, since)
    named = heard >= since or expected in answer.message
    moved = any(command != 0.0 for command in rig.commands)
    text = answer.message or rig.said[CONTROLLER].text
    hung = rig.is_silent(CONTROLLER)
    return Seen(name, expected, text, heard - since, named and not moved, False, moved, hung)


HOLD = 1.28 * PERIOD_NS * 1e-9  # s: a quarter of a period is room for late samples


def hold_faults(folder: Path, only: str) -> Iterator[Seen]:
    """A state at rest, ẋ = u, whose input is proved for a hold: samples too far apart."""
    field = VectorField.from_function(lambda x, u: [u[0]], 1, 1)  # noqa: ARG005
    t = np.linspace(0.0, 3.0, 4)
    rest = integrate_nominal(field, lambda _: [0.0], t=t, start=[0.0])
    design(ContinuousTracking(field, rest, goal=[0.2], hold=HOLD)).save(folder)
    text = Bundle.load(folder / FUNNEL).text()
    slow = dict.fromkeys((MONITOR, CONTROLLER), "design refused: samples come .* hold=")
    late = {MONITOR: "^assumption violated: the input was held", CONTROLLER: "the input was held"}
    cases = (("samples too far apart", PERIOD_NS * 1e-9, late), ("hold = period", HOLD, slow))
    for number, (name, period, said) in enumerate(cases):
        if only in name:
            os.environ["ROS_DOMAIN_ID"] = own_domain(50 + number)
            with robot() as rig:
                yield from _held(rig, name, text, period, said)


def _held(rig: Rig, name: str, text: str, period: float, said: dict[str, str]) -> Iterator[Seen]:
    """Samples of which two are 1.48 periods apart, to monitor and controller of this design."""
    wired = {"response": "/odom:twist.twist.linear.x", "command": "/cmd_vel:twist.linear.x"}
    given: dict[str, object] = {**wired, "period": period, "stale_after": PATIENT}
    with (
        python(*node(MONITOR, **given)),
        python(*node(CONTROLLER, lowest=-9.0, highest=9.0, **given)),
    ):
        rig.node.destroy_publisher(rig.command)
        rig.design.publish(String(data=text))
        ready = "^(idle$|design refused)"
        rig.need("the controller", lambda: rig.has_said(CONTROLLER, ready) >= 0)
        rig.need("the monitor", lambda: rig.has_said(MONITOR, "no x0 yet|design refused") >= 0)
        since, refused = time.monotonic(), "refused" in said[MONITOR]
        moved = rig.call(f"/{CONTROLLER}/start").success and refused
        start_ns, began = time.time_ns(), time.monotonic()
        for k in range(2 * GOOD):
            off = {GOOD: -0.24, GOOD + 1: 0.24}.get(k, 0.0)
            rig.sample(start_ns + round((k + off) * PERIOD_NS), command=None)
            rig.spin(began + (k + 1) * PERIOD_NS * 1e-9 - time.monotonic())
        for who, expected in said.items():
            rig.until(lambda: rig.has_said(who, expected) >= 0, VERDICT)  # noqa: B023
            at, hung = rig.has_said(who, expected), rig.is_silent(who)
            silent = who == MONITOR and not at >= 0
            seen = rig.said[who].text
            yield Seen(f"{name}, {who}", expected, seen, at - since, at >= 0, silent, moved, hung)


def clock_faults(rig: Rig, only: str) -> Iterator[Seen]:
    """Faults of simulated time."""
    acts: list[tuple[str, float | None, str]] = [
        ("simulator dies", None, "unknown: simulated time stands still"),
        ("/clock jumps ahead 10 s", 10.0, "^unknown"),
        ("/clock jumps back 10 s", -10.0, "^unknown"),
    ]
    for name, jump, expected in acts:
        if only not in name:
            continue
        rig.said.clear()
        with python(*node(MONITOR, stale_after=PATIENT, command_wait=0.1, use_sim_time=True)):
            rig.need("the monitor", lambda: rig.odom.get_subscription_count() >= 1)
            rig.need("its clock", lambda: rig.clock.get_subscription_count() >= 1)
            rig.need("its design", lambda: rig.has_said(MONITOR, "no speed yet") >= 0)
            since = math.nan
            for k in range(GOOD + BAD):
                stamp_ns, off = 10**18 + k * PERIOD_NS, 0.0
                if k == GOOD:
                    since = time.monotonic()
                if k >= GOOD:
                    if jump is None:
                        break
                    off = jump
                rig.sample(stamp_ns, clock_ns=stamp_ns + round(off * 1e9))
                rig.spin(PERIOD_NS * 1e-9)
            yield _judged(rig, name, expected, since)


BURNERS = 8  # processes that want the monitor's one processor, all before it


def machine_faults(rig: Rig, folder: Path, only: str) -> Iterator[Seen]:
    """A monitor that hardly gets a processor, and a recorder whose file can grow no further."""
    name = "outside, with the processor starved"
    if only in name:
        with ExitStack() as stack:
            patient = {"stale_after": PATIENT, "command_wait": 0.1}
            monitor = stack.enter_context(python(*node(MONITOR, **patient)))
            rig.need("the monitor", lambda: rig.odom.get_subscription_count() >= 1)
            rig.need("its commands", lambda: rig.command.get_subscription_count() >= 2)

            def starve(rig: Rig, k: int, stamp_ns: int) -> None:
                if k == GOOD:
                    stack.enter_context(busy(BURNERS, {0}))
                rig.sample(stamp_ns, speed=1.0)

            os.sched_setaffinity(monitor.pid, {0})
            os.setpriority(os.PRIO_PROCESS, monitor.pid, 10)
            yield _fed(rig, name, starve, "^(outside|unknown)")
    name = "full disk"
    if only in name:
        rig.said.clear()
        recorder, grown = "trajectory_recorder", 200_000
        to = {"topics": ["/odom"], "bag": folder / "full"}
        with python(*node(recorder, **to)) as running:
            rig.need("the recorder", lambda: rig.odom.get_subscription_count() >= 1)
            resource.prlimit(running.pid, resource.RLIMIT_FSIZE, (grown, grown))
            since, expected = time.monotonic(), "recording stopped"
            while not rig.has_said(recorder, expected) >= 0 and time.monotonic() < since + PATIENCE:
                rig.sample(time.time_ns())
                rig.spin(0.002)
            at, said = rig.has_said(recorder, expected), rig.said.get(recorder, Said())
            named = at >= 0 and said.level == DiagnosticStatus.ERROR and running.poll() is None
            hung = rig.is_silent(recorder)
        yield Seen(name, expected, said.text, at - since, named, hung=hung)


def bundles(good: Bundle, other: Bundle) -> list[tuple[str, str, str]]:
    """Texts that are no proved design, and why they are refused."""

    def changed(role: str, key: str, value: Any) -> Bundle:
        document = files.parse_document(good.contents[role]) | {key: value}
        return Bundle({**good.contents, role: files.encode(document)})

    funnel = files.parse_document(good.contents["funnel"])
    wider = [tube | {"level": 2.0 * tube["level"]} for tube in funnel["tubes"]]
    policy = files.parse_document(good.contents["policy"])
    gain = [[2.0 * entry for entry in row] for row in policy["K"]]
    proof = good.contents["proof"]
    forged = changed("policy", "K", gain)
    bound = files.digest(forged.contents["policy"])
    [key] = [k for k, v in funnel.items() if v == files.digest(good.contents["policy"])]
    consistent = Bundle(
        {**forged.contents, "funnel": files.encode(funnel | {key: bound}), "proof": proof}
    )
    mixed = Bundle({**good.contents, "funnel": other.contents["funnel"]})
    return [
        ("forged policy", forged.text(), "not the policy this proof is about"),
        ("forged policy and funnel", consistent.text(), "not the"),
        ("forged funnel", changed("funnel", "tubes", wider).text(), "not the"),
        ("forged model", changed("model", "c", 1.0).text(), "not the model"),
        (
            "forged proof",
            Bundle({**good.contents, "proof": proof[:-9] + b"}"}).text(),
            "not a valid",
        ),
        (
            "no proof",
            Bundle({k: v for k, v in good.contents.items() if k != "proof"}).text(),
            "there is no proof",
        ),
        ("mixed bundle", mixed.text(), "not the funnel this proof is about"),
        ("no document", "x", "not a valid document"),
        ("nested document", "[" * 10**5, "not a valid document"),
        ("huge document", "x" * (MAX_BYTES + 1), "at most"),
    ]


def design_faults(rig: Rig, good: Bundle, other: Bundle, only: str) -> Iterator[Seen]:
    """Faults in what is published as a design, to both nodes, which then are asked to move."""
    seconds = (("second publisher", good), ("second publisher, other", other))
    names = [name for name, _, _ in bundles(good, other)] + [name for name, _ in seconds]
    if not any(only in name for name in names):
        return
    rig.node.destroy_publisher(rig.command)  # from here on the controller's are the only commands
    rig.said.clear()
    stale = {"stale_after": PATIENT}
    with ExitStack() as stack:
        stack.enter_context(python(*node(MONITOR, **stale)))
        stack.enter_context(python(*node(CONTROLLER, highest=0.4, **stale)))
        rig.node.destroy_publisher(rig.design)
        rig.design = rig.node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
        rig.need("both", lambda: rig.design.get_subscription_count() >= 2)
        for name, text, because in bundles(good, other):
            if only in name:
                rig.design.publish(String(data=text))
                yield _refused(rig, name, because)
        rig.design.publish(String(data=good.text()))
        rig.need("the good one", lambda: rig.has_said(CONTROLLER, "^idle$") >= 0)
        for name, bundle in seconds:
            second = rig.node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
            second.publish(String(data=bundle.text()))
            if only in name:
                yield _refused(rig, name, "2 publishers")
            rig.node.destroy_publisher(second)
            rig.need("one publisher", lambda: "refused" not in rig.said[CONTROLLER].text)


def _refused(rig: Rig, name: str, because: str) -> Seen:
    since, rig.commands = time.monotonic(), []
    expected = f"design refused.*{because}"
    both = (MONITOR, CONTROLLER)
    rig.until(lambda: all(rig.has_said(n, expected, since) >= 0 for n in both), VERDICT)
    times = [rig.has_said(n, expected, since) for n in both]
    error = all(rig.said[n].level == DiagnosticStatus.ERROR for n in both)
    started = rig.call(f"/{CONTROLLER}/start").success
    for _ in range(10):
        rig.sample(time.time_ns(), command=None)
        rig.spin(PERIOD_NS * 1e-9)
    moved = started or bool(rig.commands)
    seconds = max(times) - since
    seen = rig.said[CONTROLLER].text
    named, hung = error and not moved and seconds >= 0, any(map(rig.is_silent, both))
    return Seen(name, expected, seen, seconds, named, moved_unproved=moved, hung=hung)


def own_domain(number: int) -> str:
    """A domain where what was killed before is not still announced."""
    return str(1 + (os.getpid() + number) % 101)


@contextmanager
def loop(
    rig: Rig, funnel: Path, **common: object
) -> Iterator[dict[str, "subprocess.Popen[bytes]"]]:
    """The plant's closed loop, tracking inside its funnel; parameters that all nodes have."""
    rig.said.clear()
    rig.commands.clear()
    stale = {"stale_after": STALE}
    watching = {"nominal": "profile", "controller": CONTROLLER, "command_wait": 0.2}
    nodes: dict[str, dict[str, object]] = {
        "funnel_publisher": {"funnel": funnel},
        "plant": {"model": funnel.with_name(MODEL), "noise": 0.002, "push": 0.6},
        MONITOR: {**stale, **watching, "stop_service": f"/{CONTROLLER}/stop"},
        # patience that is over before the plan, which lasts 2.9 s
        CONTROLLER: {**stale, "highest": 0.4, "require_monitor": True, "monitor_patience": STALE},
    }
    with ExitStack() as stack:
        running = {
            name: stack.enter_context(python(*node(name, **parameters, **common)))
            for name, parameters in nodes.items()
        }
        rig.need("the controller", lambda: rig.has_said(CONTROLLER, "^idle$") >= 0)
        rig.need("the monitor", lambda: rig.has_said(MONITOR, "waiting for the contr") >= 0)
        rig.spin(1.0)  # the graph knows of a subscription before its publisher does
        if not rig.call(f"/{CONTROLLER}/start").success:
            raise NlsidError("the run did not begin")
        rig.need("the run", lambda: rig.has_said(MONITOR, INSIDE) >= 0)
        yield running
        for process in running.values():
            process.send_signal(signal.SIGCONT)


def loop_faults(funnel: Path, only: str) -> Iterator[Seen]:
    """Nodes killed, held and pushed in mid-run: the robot comes to rest, and it is said."""
    stopped = "stopped"
    cases: list[tuple[str, str, signal.Signals | None, str, str]] = [
        ("monitor killed", MONITOR, signal.SIGKILL, CONTROLLER, f"{stopped}: {MONITOR} has judged"),
        ("monitor held", MONITOR, signal.SIGSTOP, CONTROLLER, f"{stopped}: {MONITOR} has judged"),
        ("plant killed", "plant", signal.SIGKILL, CONTROLLER, f"{stopped}: the response stopped"),
        ("plant held", "plant", signal.SIGSTOP, CONTROLLER, f"{stopped}: the response stopped"),
        ("controller killed", CONTROLLER, signal.SIGKILL, MONITOR, "^(unknown|outside|assumption)"),
        ("controller held", CONTROLLER, signal.SIGSTOP, MONITOR, "^(unknown|outside|assumption)"),
        ("publisher killed", "funnel_publisher", signal.SIGKILL, CONTROLLER, "the plan is over"),
        ("pushed out", "plant", None, CONTROLLER, f"{stopped}: (asked to|outside)"),
    ]
    for number, (name, victim, how, who, expected) in enumerate(cases, start=1):
        if only not in name:
            continue
        os.environ["ROS_DOMAIN_ID"] = own_domain(number)
        with robot(drives=False) as rig, loop(rig, funnel) as running:
            since = time.monotonic()
            if how is None:
                rig.call("/plant/push")
            else:
                running[victim].send_signal(how)
            rig.until(lambda: rig.has_said(who, expected, since) >= 0, VERDICT)  # noqa: B023
            at = rig.has_said(who, expected, since)
            silent = who == MONITOR and not at >= since
            rest = who == MONITOR or rig.until(lambda: rig.commands[-1] == 0.0, 1.0)
            seen, hung = rig.said[who].text, rig.is_silent(who)
        named = at >= since and rest
        yield Seen(name, expected, seen, at - since, named, silent_inside=silent, hung=hung)
    if only in SIMULATED:
        yield simulated(funnel)


SIMULATED = "a good run, /clock once a sample"


def simulated(funnel: Path) -> Seen:
    """Whether a run that goes well in simulated time ends without an alarm."""
    os.environ["ROS_DOMAIN_ID"] = own_domain(0)
    with robot(drives=False) as rig:
        clock, ticks = rig.node.create_publisher(Clock, "/clock", qos.STREAM), count(4 * 10**10)

        def tick() -> None:
            now = Clock()
            now.clock.sec, now.clock.nanosec = divmod(next(ticks) * PERIOD_NS, 10**9)
            clock.publish(now)

        rig.node.create_timer(PERIOD_NS * 1e-9, tick)
        with loop(rig, funnel, use_sim_time=True):
            since, expected = time.monotonic(), "unknown: the run has ended: the plan is over"
            rig.until(lambda: rig.has_said(MONITOR, expected) >= 0, VERDICT)
            at, said = rig.has_said(MONITOR, expected), rig.said[MONITOR]
            alarmed = any(level == DiagnosticStatus.ERROR for _, level, _ in said.lines)
            hung = rig.is_silent(MONITOR)
    return Seen(SIMULATED, expected, said.text, at - since, at >= 0 and not alarmed, hung=hung)


@contextmanager
def robot(*, drives: bool = True) -> Iterator[Rig]:
    """A rig in this process, which is the robot, or only listens where the plant is."""
    context = Context()
    rclpy.init(context=context)
    made = Node("rig", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(made)
    try:
        yield Rig(made, executor, drives=drives)
    finally:
        executor.shutdown()
        made.destroy_node()
        context.try_shutdown()


def run(folder: Path, only: str = "") -> Iterator[Seen]:
    """Every fault whose name contains `only`."""
    config = load_config(config_file("f1tenth.yaml"))
    made = []
    for name, factor in (("good", 1.5), ("other", 2.0)):
        out = folder / name
        identify_bags(f1tenth(), config, out, progress=silent)
        assert config.funnel is not None
        wider = config.funnel.model_copy(update={"safety_factor": factor})
        design_funnel_files(out / MODEL, config.model_copy(update={"funnel": wider}), out)
        made.append(out / FUNNEL)
    good, other = map(Bundle.load, made)
    with robot() as rig:
        rig.design.publish(String(data=good.text()))
        yield from message_faults(rig, only)
        yield from clock_faults(rig, only)
        yield from machine_faults(rig, folder, only)
        yield from design_faults(rig, good, other, only)
        yield from verdict_faults(rig, good, other, only)
    yield from hold_faults(folder / "held", only)
    yield from loop_faults(made[0], only)


def main() -> None:
    """Print the table; with --json the last line is one JSON object."""
    taken = parser(__doc__)
    taken.add_argument("--only", default="", help="faults whose name contains this")
    options = taken.parse_args()
    isolate()
    print(describe())
    seen: list[Seen] = []
    with tempfile.TemporaryDirectory() as folder:
        for each in run(Path(folder), options.only):
            seen.append(each)
            sign = "ok" if each.as_expected else "NOT AS EXPECTED"
            print(f"{each.fault:30} {each.seconds:7.3f} s  {sign:16} {each.seen[:90]}", flush=True)
    result = {
        "faults": len(seen),
        "as_expected": sum(each.as_expected for each in seen),
        "silent_inside": sum(each.silent_inside for each in seen),
        "moved_unproved": sum(each.moved_unproved for each in seen),
        "hung": sum(each.hung for each in seen),
    }
    print(result)
    if options.json:
        print(json.dumps(result | {"each": [asdict(each) for each in seen]}))
    sys.exit(0 if result["as_expected"] == len(seen) else 1)


if __name__ == "__main__":
    main()
