"""The three workflows as one command starts them, and the launch files behind them."""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM, Signals

import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.chain.config import load_config
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter
from bags.samples import f1tenth
from nlsid_core import files
from nlsid_core.models import DifferenceEquation
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of
from tests.ros.processes import ROOT, STARTED, SpinUntil, call, node_here, process, ros_test

pytestmark = ros_test

ENDED = 40.0  # s for all nodes of a workflow to end when asked to
PATIENT = ["stale_after:=1.0", "command_wait:=0.5"]  # the machine may be busy with other tests


class Operator:
    """Hears what the nodes say and calls their services."""

    def __init__(self, node: Node, spin_until: SpinUntil) -> None:
        self.node, self.spin_until = node, spin_until
        self.said: dict[str, list[str]] = {}
        self.values: dict[str, dict[str, str]] = {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._hear, qos.EVENTS)

    def _hear(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.said.setdefault(status.name, []).append(status.message)
            self.values[status.name] = {entry.key: entry.value for entry in status.values}

    def has_said(self, node: str, text: str) -> bool:
        """Whether `node` has said something with `text`."""
        return any(text in said for said in self.said.get(node, []))

    def hears(self, node: str, text: str) -> None:
        """Wait for it."""
        self.spin_until(lambda: self.has_said(node, text))

    def call(self, service: str) -> None:
        """Call a std_srvs/Trigger that succeeds."""
        assert self.asks(service) == ""

    def asks(self, service: str) -> str:
        """Call a std_srvs/Trigger; why it did not succeed, empty if it did."""
        answer = call(self.node, self.spin_until, service)
        return "" if answer.success else str(answer.message)

    def waits(self, seconds: float) -> None:
        """Let time pass."""
        until = time.monotonic() + seconds
        self.spin_until(lambda: time.monotonic() > until)


@pytest.fixture
def operator() -> Iterator[Operator]:
    with node_here("test_operator") as (node, spin_until):
        yield Operator(node, spin_until)


@contextmanager
def live(workflow: str, *arguments: str) -> Iterator[None]:
    """`nlsid run`, interrupted at the end and then expected to have ended well."""
    command = [sys.executable, "-m", "bags.commands.cli", "run", workflow, *arguments]
    running = subprocess.Popen(command, cwd=ROOT)
    try:
        yield
        running.send_signal(SIGINT)
        assert running.wait(timeout=ENDED) == 0
    finally:
        if running.poll() is None:
            running.send_signal(SIGINT)
            running.wait(timeout=ENDED)


def test_monitor_only_on_an_existing_stack(operator: Operator, funnel: Path) -> None:
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    with live("monitor", f"funnel:={funnel}", "allow_old_stamps:=true", *PATIENT):
        operator.hears("funnel_monitor", " yet")
        topics = "['/odom', '/cmd_vel']"
        with process("nlsid_ros.bag_player", bag=trial, topics=topics) as player:
            operator.hears("funnel_monitor", "inside")
            operator.hears("funnel_monitor", "unknown: no speed for 1 s")
            assert player.wait(timeout=STARTED) == 0
    assert not operator.has_said("funnel_monitor", "outside")
    assert not operator.has_said("funnel_monitor", "violated")


@pytest.mark.parametrize("how", [SIGTERM, SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_nodes_end_with_the_command_that_started_them(
    operator: Operator, funnel: Path, how: Signals
) -> None:
    model = funnel.with_name(documents.MODEL)
    arguments = [f"funnel:={funnel}", f"model:={model}", "plant:=true", "highest:=0.4", *PATIENT]
    command = [sys.executable, "-m", "bags.commands.cli", "run", "control", *arguments]
    commands: list[float] = []

    def hear(message: TwistStamped) -> None:
        commands.append(message.twist.linear.x)

    operator.node.create_subscription(TwistStamped, "/cmd_vel", hear, qos.STREAM)
    running = subprocess.Popen(command, cwd=ROOT)
    try:
        operator.hears("funnel_monitor", "waiting for the controller")
        operator.hears("tracking_controller", "idle")
        counted = operator.node.count_subscribers
        operator.spin_until(lambda: counted("/cmd_vel") >= 3)  # plant, monitor and this one
        operator.waits(1.0)  # the graph knows a subscription before its publisher does
        operator.call("/tracking_controller/start")
        operator.hears("funnel_monitor", "inside")
        children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
        assert len(children) == 4
        running.send_signal(how)
        running.wait(timeout=ENDED)
        operator.spin_until(lambda: not any(_runs(child) for child in children))
        operator.spin_until(lambda: operator.node.get_node_names() == ["test_operator"])
    finally:
        running.kill()
        running.wait()
    assert max(commands) > 0.0
    operator.spin_until(lambda: commands[-1] == 0.0)  # it ramped down


def _runs(pid: str) -> bool:
    """Whether a process is there and has not ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def test_a_tube_without_a_policy_is_monitored_for_as_long_as_the_robot_runs(
    operator: Operator, tmp_path: Path
) -> None:
    """Around the model's own simulation: margins heard are those of the replay, bit for bit."""
    content = yaml.safe_load((ROOT / "config" / "f1tenth.yaml").read_text())
    content["funnel"] = {}
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    config, out = load_config(path), tmp_path / "out"
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    replayed = replay_bag(documents.load(out / documents.FUNNEL), trial, centre=Centre.COMMAND)
    assert replayed.verdict == "inside"
    expected = [
        (stamp, reading.margin)
        for stamp, reading in zip(replayed.stamps_ns, replayed.readings, strict=True)
        if reading.status is Status.INSIDE
    ]
    heard: dict[int, float] = {}

    def margin(message: JointState) -> None:
        heard[stamp_ns_of(message)] = message.position[0]

    operator.node.create_subscription(JointState, "/funnel_monitor/margin", margin, qos.STREAM)
    funnel = out / documents.FUNNEL
    with live("monitor", f"funnel:={funnel}", "allow_old_stamps:=true", *PATIENT):
        operator.hears("funnel_monitor", " yet")
        topics = "['/odom', '/cmd_vel']"
        with process("nlsid_ros.bag_player", bag=trial, topics=topics) as player:
            operator.hears("funnel_monitor", "inside")
            operator.spin_until(lambda: {stamp for stamp, _ in expected} <= heard.keys())
            assert player.wait(timeout=STARTED) == 0
        operator.hears("funnel_monitor", "unknown: no speed for 1 s")
    assert len(expected) > 100
    assert [(stamp, heard[stamp]) for stamp, _ in expected] == expected
    assert not operator.has_said("funnel_monitor", "outside")
    assert not operator.has_said("funnel_monitor", "violated")


def test_two_robots_in_two_namespaces_one_pushed_out_of_its_funnel_and_one_not(
    operator: Operator, funnel: Path
) -> None:
    def robot(name: str, push: float) -> list[str]:
        return [
            f"namespace:=/{name}",
            f"funnel:={funnel}",
            f"model:={funnel.with_name(documents.MODEL)}",
            "plant:=true",
            "highest:=0.4",
            f"push:={push}",
            *PATIENT,
        ]

    with ExitStack() as stack:
        for name, push in (("gentle", 0.05), ("hard", 0.6)):
            stack.enter_context(live("control", *robot(name, push)))
        for name in ("gentle", "hard"):
            operator.hears(f"{name}/tracking_controller", "idle")
            operator.hears(f"{name}/funnel_monitor", "waiting for the controller")
        for name in ("gentle", "hard"):
            operator.call(f"/{name}/tracking_controller/start")
        for name in ("gentle", "hard"):
            operator.hears(f"{name}/funnel_monitor", "inside")
        operator.waits(1.0)
        for name in ("gentle", "hard"):
            operator.call(f"/{name}/plant/push")
        operator.hears("hard/funnel_monitor", "outside the tube")
        ends = ("asked to", "outside: funnel_monitor says")  # whichever is heard first
        operator.spin_until(
            lambda: any(
                operator.has_said("hard/tracking_controller", f"idle; stopped: {end}")
                for end in ends
            )
        )
        operator.hears("gentle/tracking_controller", "idle; stopped: the plan is over")
        names = {name for name, _ in operator.node.get_topic_names_and_types()}
    assert not operator.has_said("gentle/funnel_monitor", "outside")
    assert not operator.has_said("gentle/funnel_monitor", "violated")
    assert {"/gentle/odom", "/hard/odom", "/diagnostics"} <= names
    assert not {"/odom", "/cmd_vel"} & names, "nothing is outside the namespaces"


def test_all_nodes_in_one_process_hold_the_loop_while_a_proof_is_decided(
    operator: Operator, funnel: Path, tmp_path: Path
) -> None:
    """Every sample is judged and has its command: nobody starves. Then a push, and an alarm."""
    for file in funnel.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    given = [
        f"funnel:={tmp_path / funnel.name}",
        f"model:={funnel.with_name(documents.MODEL)}",
        "plant:=true",
        "highest:=0.4",
        "push:=0.6",
        *PATIENT,
    ]
    margins: dict[int, float] = {}

    def judge(message: JointState) -> None:
        margins[stamp_ns_of(message)] = message.position[message.name.index("margin")]

    def inside() -> list[int]:
        return sorted(stamp_ns for stamp_ns, margin in margins.items() if margin >= 0.0)

    operator.node.create_subscription(JointState, "/funnel_monitor/margin", judge, qos.STREAM)
    with live("control", *given, "--one-process"):
        operator.hears("tracking_controller", "idle")
        operator.hears("funnel_monitor", "waiting for the controller")
        operator.call("/tracking_controller/start")
        operator.hears("funnel_monitor", "inside")
        operator.said.clear()
        proof = tmp_path / documents.FUNNEL_PROOF
        proof.write_text(proof.read_text().replace('"proof":', " " * 10**6 + '"proof":'))
        operator.hears("tracking_controller", "idle; stopped: the p")
        stamps = inside()
        assert len(stamps) == 117
        assert {round((b - a) / 25e6) for a, b in pairwise(stamps)} == {1}
        operator.call("/funnel_monitor/restart")
        operator.spin_until(lambda: operator.asks("/tracking_controller/start") == "")
        operator.spin_until(lambda: len(inside()) > 140)
        operator.call("/plant/push")
        operator.hears("funnel_monitor", "outside the tube")
        operator.hears("tracking_controller", "idle; stopped: ")


def test_record_an_excited_robot_then_identify_it_with_what_was_recorded(
    operator: Operator, funnel: Path, tmp_path: Path
) -> None:
    trials = tmp_path / "trials"
    trials.mkdir()
    for bag in f1tenth():
        (trials / bag.name).symlink_to(bag)
    common = [f"config:={ROOT / 'config' / 'f1tenth.yaml'}", f"trials:={trials}"]
    common.append(f"out:={tmp_path / 'out'}")
    excite = ["excite:=true", "highest:=0.3", "slew:=1.0", "duration:=3.0"]
    with (
        process("nlsid_ros.plant", model=funnel.with_name(documents.MODEL), noise=0.002),
        live("identify", *common, *excite, f"bag:={trials / 'trial_new'}"),
    ):
        listeners = {"/odom": 1, "/cmd_vel": 2}  # recorder and plant
        operator.spin_until(
            lambda: all(operator.node.count_subscribers(t) >= n for t, n in listeners.items())
        )
        operator.call("/excitation/start")
        operator.hears("excitation", "done")
        operator.waits(0.5)  # what was said last is on its way to the recorder
    with Bag(trials / "trial_new") as recorded:
        assert recorded.count("/odom") > 100
        assert recorded.count("/cmd_vel") > 80
        assert recorded.count("/excitation/experiment") == 2  # its start and its end

    models: list[String] = []
    operator.node.create_subscription(
        String, "/model_identifier/model", models.append, qos.DOCUMENT
    )
    with live("identify", *common, f"bag:={tmp_path / 'another'}"):
        operator.call("/model_identifier/identify")
        operator.hears("model_identifier", "PROVED")
        operator.spin_until(lambda: len(models) == 1)
    model = DifferenceEquation.from_document(files.parse_document(models[0].data))
    assert len(model) == 4


def test_what_is_recorded_and_excited_is_what_the_configuration_names(
    operator: Operator, tmp_path: Path
) -> None:
    """A robot whose topics have other names, and a recording that goes on while it is identified:
    the one that is open and the one without a command are left out.
    """
    trials = tmp_path / "trials"
    for k, bag in enumerate(f1tenth()):
        topics = {"/odom": "/diff/odom", "/cmd_vel": "/diff/cmd_vel"}
        renamed(bag, trials / bag.name, topics if k else {"/odom": "/diff/odom"})
    config = tmp_path / "config.yaml"
    text = (ROOT / "config" / "f1tenth.yaml").read_text()
    config.write_text(
        text.replace('"/odom:', '"/diff/odom:').replace('"/cmd_vel:', '"/diff/cmd_vel:')
    )
    given = [f"config:={config}", f"trials:={trials}", f"out:={tmp_path / 'out'}"]
    given += ["excite:=true", "highest:=0.3", "slew:=1.0", "duration:=1.0"]
    given += [f"bag:={trials / 'trial_new'}"]
    with live("identify", *given):
        operator.spin_until(lambda: operator.node.count_publishers("/diff/cmd_vel") == 1)
        operator.spin_until(lambda: operator.node.count_subscribers("/diff/cmd_vel") == 1)
        assert operator.node.count_publishers("/cmd_vel") == 0
        operator.call("/model_identifier/identify")
        operator.hears("model_identifier", "PROVED")
        left_out = operator.values["model_identifier"]["left out"]
        assert "trial_new: it is not closed" in left_out
        assert "trial_01: it has nothing on /diff/cmd_vel" in left_out
        operator.call("/excitation/start")
        operator.hears("excitation", "done")
        operator.waits(0.5)
    with Bag(trials / "trial_new") as recorded:
        assert recorded.count("/diff/cmd_vel") > 30
        assert "/cmd_vel" not in recorded.topics


def renamed(bag: Path, target: Path, topics: dict[str, str]) -> None:
    """The messages on these topics of a bag, on topics of other names."""
    with Bag(bag) as source, BagWriter(target) as writer:
        for message in source.messages():
            if message.topic in topics:
                writer.write(
                    topics[message.topic],
                    message.msgtype,
                    message.data,
                    log_time_ns=message.log_time_ns,
                    publish_time_ns=message.log_time_ns,
                )


def test_a_workflow_that_is_told_too_little_says_what_it_takes() -> None:
    command = [sys.executable, "-m", "bags.commands.cli", "run", "control"]
    done = subprocess.run(
        [*command, "funnel:=x.json", "highest:=1.0", "plants:=true"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=STARTED,
        check=False,
    )
    assert done.returncode == 2
    assert "'plants:=true' is not one of the arguments of control.launch.xml" in done.stderr
    assert "stale_after:=0.0" in done.stderr
