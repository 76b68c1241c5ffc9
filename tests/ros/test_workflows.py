"""The three workflows as one command starts them, and the launch files behind them."""

import math
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path
from signal import SIGINT, SIGKILL, SIGTERM, Signals

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from geometry_msgs.msg import TwistStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.monitoring.replay import replay_bag
from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter
from bags.setup.candidates import look
from bags.setup.proposing import Chosen, propose
from bags.setup.written import yaml_text
from nlsid import Status, f1tenth
from nlsid_core import files
from nlsid_core.models import DifferenceEquation
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of, stamp_of
from tests.ros.processes import ROOT, STARTED, Bench, process, ros_test, stop

pytestmark = ros_test

ENDED = 40.0  # s for all nodes of a workflow to end when asked to
PATIENT = ["stale_after:=1.0", "command_wait:=0.5"]  # the machine may be busy with other tests


@pytest.fixture
def margins(bench: Bench) -> dict[int, dict[str, float]]:
    """The numbers of the monitor's margins, by stamp (ns)."""
    heard: dict[int, dict[str, float]] = {}

    def hear(message: JointState) -> None:
        numbers = zip(message.name, message.position, strict=True)
        heard[stamp_ns_of(message)] = dict(numbers)

    bench.listen(JointState, "/funnel_monitor/margin", hear)
    return heard


@contextmanager
def live(workflow: str, *arguments: str) -> Iterator[None]:
    """`nlsid run`, interrupted at the end and then expected to have ended well."""
    command = [sys.executable, "-m", "bags.commands.main", "run", workflow, *arguments]
    running = subprocess.Popen(command, cwd=ROOT)
    try:
        yield
        running.send_signal(SIGINT)
        assert running.wait(timeout=ENDED) == 0
    finally:
        if running.poll() is None:
            running.send_signal(SIGINT)
            running.wait(timeout=ENDED)


def test_monitor_only_on_an_existing_stack(bench: Bench, funnel: Path) -> None:
    trial = next(bag for bag in f1tenth() if bag.name == "trial_05")
    with live("monitor", f"funnel:={funnel}", "allow_old_stamps:=true", *PATIENT):
        bench.hears(" yet", "funnel_monitor")
        topics = "['/odom', '/cmd_vel']"
        player = bench.start("bag_player", bag=trial, topics=topics)
        bench.hears("inside", "funnel_monitor")
        bench.hears("unknown: no speed for 1 s", "funnel_monitor")
        assert player.wait(timeout=STARTED) == 0
    assert not bench.has_said("outside", "funnel_monitor")
    assert not bench.has_said("violated", "funnel_monitor")


@pytest.mark.parametrize("how", [SIGTERM, SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_nodes_end_with_the_command_that_started_them(
    bench: Bench, funnel: Path, how: Signals
) -> None:
    model = funnel.with_name(documents.MODEL)
    arguments = [f"funnel:={funnel}", f"model:={model}", "plant:=true", "highest:=0.4", *PATIENT]
    command = [sys.executable, "-m", "bags.commands.main", "run", "control", *arguments]
    commands: list[float] = []

    def hear(message: TwistStamped) -> None:
        commands.append(message.twist.linear.x)

    bench.listen(TwistStamped, "/cmd_vel", hear)
    running = subprocess.Popen(command, cwd=ROOT)
    try:
        bench.hears("waiting for the controller", "funnel_monitor")
        bench.hears("idle", "tracking_controller")
        counted = bench.node.count_subscribers
        bench.spin_until(lambda: counted("/cmd_vel") >= 3)  # plant, monitor and this one
        bench.waits(1.0)  # the graph knows a subscription before its publisher does
        assert bench.call("/tracking_controller/start").success
        bench.hears("inside", "funnel_monitor")
        children = Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()
        assert len(children) == 4
        running.send_signal(how)
        running.wait(timeout=ENDED)
        bench.spin_until(lambda: not any(_runs(child) for child in children))
        bench.spin_until(lambda: bench.node.get_node_names() == ["test_robot"])
    finally:
        running.kill()
        running.wait()
    assert max(commands) > 0.0
    bench.spin_until(lambda: commands[-1] == 0.0)  # it ramped down


def _runs(pid: str) -> bool:
    """Whether a process is there and has not ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def test_a_tube_without_a_policy_is_monitored_for_as_long_as_the_robot_runs(
    bench: Bench, margins: dict[int, dict[str, float]], tmp_path: Path
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
    funnel = out / documents.FUNNEL
    with live("monitor", f"funnel:={funnel}", "allow_old_stamps:=true", *PATIENT):
        bench.hears(" yet", "funnel_monitor")
        topics = "['/odom', '/cmd_vel']"
        player = bench.start("bag_player", bag=trial, topics=topics)
        bench.hears("inside", "funnel_monitor")
        bench.spin_until(lambda: {stamp for stamp, _ in expected} <= margins.keys())
        assert player.wait(timeout=STARTED) == 0
        bench.hears("unknown: no speed for 1 s", "funnel_monitor")
    assert len(expected) > 100
    assert [(stamp, margins[stamp]["margin"]) for stamp, _ in expected] == expected
    assert not bench.has_said("outside", "funnel_monitor")
    assert not bench.has_said("violated", "funnel_monitor")


def test_two_robots_in_two_namespaces_one_pushed_out_of_its_funnel_and_one_not(
    bench: Bench, funnel: Path
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
            bench.hears("idle", f"{name}/tracking_controller")
            bench.hears("waiting for the controller", f"{name}/funnel_monitor")
        for name in ("gentle", "hard"):
            assert bench.call(f"/{name}/tracking_controller/start").success
        for name in ("gentle", "hard"):
            bench.hears("inside", f"{name}/funnel_monitor")
        bench.waits(1.0)
        for name in ("gentle", "hard"):
            assert bench.call(f"/{name}/plant/push").success
        first = ("outside", "assumption violated")  # whichever is heard first ends the run
        bench.spin_until(
            lambda: any(
                bench.has_said(f"idle; stopped: {end}", "hard/tracking_controller")
                for end in ("asked to", *(f"{said}: funnel_monitor says" for said in first))
            )
        )
        bench.spin_until(lambda: any(bench.has_said(s, "hard/funnel_monitor") for s in first))
        bench.hears("idle; stopped: the plan is over", "gentle/tracking_controller")
        names = {name for name, _ in bench.node.get_topic_names_and_types()}
    assert not bench.has_said("outside", "gentle/funnel_monitor")
    assert not bench.has_said("violated", "gentle/funnel_monitor")
    assert {"/gentle/odom", "/hard/odom", "/diagnostics"} <= names
    assert not {"/odom", "/cmd_vel"} & names, "nothing is outside the namespaces"


def test_record_an_excited_robot_then_identify_it_with_what_was_recorded(
    bench: Bench, funnel: Path, tmp_path: Path
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
        bench.spin_until(
            lambda: all(bench.node.count_subscribers(t) >= n for t, n in listeners.items())
        )
        assert bench.call("/excitation/start").success
        bench.hears("done", "excitation")
        bench.waits(0.5)  # what was said last is on its way to the recorder
    with Bag(trials / "trial_new") as recorded:
        assert recorded.count("/odom") > 100
        assert recorded.count("/cmd_vel") > 80
        assert recorded.count("/excitation/experiment") == 2  # its start and its end

    models: list[String] = []
    bench.listen(String, "/model_identifier/model", models.append, qos.DOCUMENT)
    with live("identify", *common, f"bag:={tmp_path / 'another'}"):
        assert bench.call("/model_identifier/identify").success
        bench.hears("PROVED", "model_identifier")
        bench.spin_until(lambda: len(models) == 1)
    model = DifferenceEquation.from_document(files.parse_document(models[0].data))
    assert len(model) == 4


def test_what_is_recorded_and_excited_is_what_the_configuration_names(
    bench: Bench, tmp_path: Path
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
        bench.spin_until(lambda: bench.node.count_publishers("/diff/cmd_vel") == 1)
        bench.spin_until(lambda: bench.node.count_subscribers("/diff/cmd_vel") == 1)
        assert bench.node.count_publishers("/cmd_vel") == 0
        answer = bench.call("/model_identifier/identify")
        assert answer.success
        assert "trial_new: it is not closed" in answer.message
        assert "trial_01: it has nothing on /diff/cmd_vel" in answer.message
        bench.hears("PROVED", "model_identifier")
        assert bench.call("/excitation/start").success
        bench.hears("done", "excitation")
        bench.waits(0.5)
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


@pytest.mark.parametrize(
    ("given", "status", "says"),
    [
        ("params_file:=nowhere.yaml", 1, "nowhere.yaml'. Error: Error opening YAML file"),
        ("/odom:=/9 x", 1, "Couldn't parse remap rule: '-r /odom:=/9 x'\n"),
        ("plants:=true", 2, "'plants:=true' is not one of the arguments of monitor.launch.xml"),
        ("plants:=true", 2, "stale_after:=0.0"),
    ],
)
def test_what_a_workflow_cannot_use_is_said_with_the_reason_and_no_traceback(
    given: str, status: int, says: str
) -> None:
    """The first node that ends has the others end while they are still starting."""
    command = [sys.executable, "-m", "bags.commands.main", "run", "monitor", "funnel:=x.json"]
    done = subprocess.run(
        [*command, given], capture_output=True, text=True, cwd=ROOT, timeout=STARTED, check=False
    )
    assert done.returncode == status
    assert says in done.stderr
    assert "Traceback" not in done.stderr


def test_a_node_that_is_ended_while_it_starts_says_nothing_of_it() -> None:
    code = (
        "import sys; from bags.commands.launching import run_together; python = sys.executable; "
        "first, node = [python, '-c', 'raise SystemExit(3)'], [python, '-m', sys.argv[1]]; "
        "sys.exit(run_together([first, node]))"
    )
    command = [sys.executable, "-c", code, "nlsid_ros.funnel_monitor"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=STARTED, check=False)
    assert (done.returncode, done.stderr) == (3, "")


TOPICS = "['/odom', '/cmd_vel', '/tracking_controller/run', '/diagnostics']"


@pytest.mark.parametrize(
    ("push", "pace"), [(0.05, None), (0.05, 0.2), (0.05, 5.0), (0.6, None)], ids=str
)
def test_the_loop_is_closed_and_judged_as_in_replay_whether_pushed_gently_or_too_hard(
    bench: Bench,
    margins: dict[int, dict[str, float]],
    funnel: Path,
    tmp_path: Path,
    push: float,
    pace: float | None,
) -> None:
    """Pushed 1 s after it started tracking. pace: of simulated time; /clock ticks once a sample, so
    that commands have the stamps of samples.
    """
    bag, controller = tmp_path / "run", "tracking_controller"
    clock = bench.node.create_publisher(Clock, "/clock", qos.STREAM)
    ticks = count(10**18, 25_000_000)
    simulated, faster = pace is not None, pace or 1.0
    patient = max(1.0, faster)  # s; the machine may be busy with other tests
    if simulated:
        bench.node.create_timer(
            0.025 / faster, lambda: clock.publish(Clock(clock=stamp_of(next(ticks))))
        )
    nodes: dict[str, dict[str, object]] = {
        "trajectory_recorder": {"topics": TOPICS, "bag": bag, "snapshot": 10.0},
        "funnel_publisher": {"funnel": funnel},
        "funnel_monitor": {
            "nominal": "profile",
            "controller": controller,
            "stop_service": "/tracking_controller/stop",
            "snapshot_service": "/trajectory_recorder/snapshot",
            "command_wait": min(0.5 * patient, 1.0),
            "stale_after": patient,
        },
        controller: {"highest": 0.4, "stale_after": patient},
        "plant": {"model": funnel.with_name(documents.MODEL), "noise": 0.002, "push": push},
    }
    running = [bench.start(name, **given, use_sim_time=simulated) for name, given in nodes.items()]
    bench.hears("idle", controller)
    counted = bench.node.count_subscribers
    bench.spin_until(lambda: min(map(counted, ("/cmd_vel", "/odom"))) >= 3)
    bench.hears("waiting for the controller")
    bench.waits(1.0)  # the graph knows a recorder before the plant does
    assert bench.call(f"/{controller}/start").success
    bench.hears("inside")
    bench.waits(1.0 / faster)
    assert bench.call("/plant/push").success
    bench.hears("idle; stopped", controller)
    over = ("the run has ended", "outside")
    bench.spin_until(lambda: any(map(bench.has_said, over)))
    for each in running:
        stop(each)

    replay = replay_bag(documents.load(funnel), bag, centre=Centre.PROFILE)
    judged = {
        stamp_ns: reading.numbers
        for stamp_ns, reading in zip(replay.stamps_ns, replay.readings, strict=True)
        if reading.status is not Status.UNKNOWN
    }
    live_ns = [stamp for stamp, numbers in margins.items() if not math.isnan(numbers["margin"])]
    common = judged.keys() & set(live_ns)
    assert len(common) >= 0.9 * len(live_ns) > 0
    for stamp in common:
        heard = {key: margins[stamp][key] for key in judged[stamp]}
        assert np.array_equal(list(heard.values()), list(judged[stamp].values()), equal_nan=True)
    least = min(judged[stamp]["margin"] for stamp in common)
    snapshot = bag.with_name("run_snapshot_1")
    if push < 0.1:
        bench.hears("idle; stopped: the plan is over", controller)
        assert not bench.has_said("outside")
        assert not bench.has_said("violated")
        assert bench.has_said("unknown: the run has ended: the plan is over")
        assert (len(common), least > 0.3, snapshot.exists()) == (117, True, False)
        return
    assert bench.has_said("idle; stopped: asked to", controller)
    assert bench.has_said("above the level")
    assert bench.has_said("outside the tube")
    assert least < 0.0
    with Bag(bag) as source:
        events = b"".join(m.data for m in source.messages(["/diagnostics"]))
    assert b"above the level" in events
    with Bag(snapshot) as source:
        assert source.count("/odom") > 40, "what led there was kept"


def demonstrated(funnel: Path, out: Path) -> subprocess.CompletedProcess[str]:
    """The live demonstration on trial 5; it says itself whether all is as it should be."""
    command = [sys.executable, "-m", "nlsid_ros.demo.live", "--funnel", str(funnel)]
    options = ["--bag", str(f1tenth()[4]), "--out", str(out)]
    return subprocess.run(command + options, capture_output=True, text=True, check=False)


def test_live_nodes_agree_with_the_offline_replay(funnel: Path, tmp_path: Path) -> None:
    done = demonstrated(funnel, tmp_path / "live")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "recorder: 241 of 241 messages, equal to what was sent" in done.stdout
    assert "monitor: 117 of 117 margins, at most 0.0e+00 from the offline" in done.stdout
    assert "above the level" in done.stdout


def test_a_demonstration_whose_fault_would_not_be_flagged_is_refused_by_name(
    funnel: Path, tmp_path: Path
) -> None:
    config = load_config(config_file("f1tenth.yaml"))
    assert config.funnel is not None
    wide = config.funnel.model_copy(update={"safety_factor": 100.0})
    settings = config.model_copy(update={"funnel": wide})
    design_funnel_files(funnel.with_name(documents.MODEL), settings, tmp_path)
    done = demonstrated(tmp_path / documents.FUNNEL, tmp_path / "live")
    assert done.returncode == 1
    [said] = done.stderr.splitlines()
    assert "live: trial_05 with its sensor scaled by 0.6 is not flagged: inside" in said


def test_two_commands_and_two_responses_on_three_topics_are_judged_live_as_in_replay(
    tmp_path: Path,
) -> None:
    """The F1TENTH car: speed and steering commands to speed and yaw rate, over DDS."""
    bags, config, out = f1tenth(), tmp_path / "robot.yaml", tmp_path / "two_by_two"
    chosen = Chosen(
        ("/odom:twist.twist.linear.x", "/odom:pose.pose.orientation.yaw|unwrap|derivative(0.12 s)"),
        ("/cmd_vel:twist.linear.x", "/steering_command:position[name=steering]"),
    )
    config.write_text(yaml_text(propose(bags, look(bags), chosen)))
    settings = load_config(config)
    identify_bags(bags, settings, out, progress=silent)
    design_funnel_files(out / documents.MODEL, settings, out)
    done = demonstrated(out / documents.FUNNEL, tmp_path / "live")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "recorder: 361 of 361 messages, equal to what was sent" in done.stdout
