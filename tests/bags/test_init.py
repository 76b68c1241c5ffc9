"""`nlsid init`: a configuration from bags that the whole way takes as it is."""

import re
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.signal import lfilter

from bags.chain.config import load_config
from bags.chain.identification_config import section_of
from bags.chain.training import decoded
from bags.commands.init import said_briefly
from bags.designs import documents
from bags.recordings.writer import BagWriter
from bags.samples import f1tenth, schunk
from bags.setup.candidates import choose, look
from bags.setup.proposal import Proposal
from bags.setup.proposing import take_next
from bags.tools.fitness import check_fitness
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import BagError, DataError
from nlsid_core.identification import Attempt, Choice, LeastSquares, Polynomial
from nlsid_core.identification.choosing import HeldOut
from tests.bag_messages import (
    CMD_TYPE,
    COMMAND,
    JOINT_TYPE,
    SPEED,
    START_NS,
    command,
    header,
    joints,
    number_bag,
    odometry,
    put,
    serialised,
    speed_bag,
    twist,
)
from tests.conftest import SHARED
from tests.verbs import nlsid

CMD = "/cmd_vel:twist.linear.x"
POSITION = "/odom:pose.pose.position.x"
YAW = "/odom:pose.pose.orientation.yaw|unwrap|derivative(0.12 s)"


def whole_way(bags: Path, config: Path, out: Path) -> str:
    """Identify, design, decide, replay: what the last of them says."""
    nlsid("identify", out, bags, "--config", config)
    nlsid("funnel", out, "--config", config)
    said = nlsid("check", out)
    assert said.count("PROVED ") == 2
    said = nlsid("monitor", out, bags, "--config", config, status=(0, 1))
    assert "unknown" not in said
    return said


@pytest.mark.slow
@pytest.mark.pictures
@pytest.mark.parametrize(
    ("options", "response", "excitation"),
    [((), YAW, "/steering_command:position[name=steering]"), (("-u", CMD), SPEED, CMD)],
)
def test_the_written_file_goes_the_whole_way_on_the_f1tenth_bags(
    tmp_path: Path, options: tuple[str, ...], response: str, excitation: str
) -> None:
    bags, config = f1tenth()[0].parent, tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, bags, *options)
    settings = load_config(config)
    signals = settings.signals
    assert (signals.response[0].path, signals.excitation[0].path) == (response, excitation)
    assert (settings.grid.period, settings.clock, len(settings.split.test)) == (0.025, "header", 8)
    assert f"{response}: " in said
    assert whole_way(bags, config, tmp_path / "out").count("inside") == 8


def test_every_key_of_the_written_file_has_a_comment(axes: tuple[Path, str]) -> None:
    lines = axes[0].read_text().splitlines()
    keys = [k for k, line in enumerate(lines) if re.match(r" *[a-z_]+:", line)]
    assert len(keys) >= 15
    assert not [lines[k] for k in keys if not lines[k - 1].lstrip().startswith("#")]
    assert max(map(len, lines)) < 160


def boat(folder: Path, trials: int = 4) -> tuple[Path, Path]:
    """Bags of types that only .msg files define, in a folder; and those files' package."""
    package = folder / "my_boat"
    (package / "msg").mkdir(parents=True)
    (package / "msg" / "Thrust.msg").write_text("std_msgs/Header header\nfloat32[2] thrust\n")
    (package / "msg" / "Nav.msg").write_text("std_msgs/Header header\nfloat64 surge\n")
    types = get_typestore(Stores.ROS2_JAZZY)
    for kind in ("Thrust", "Nav"):
        text = (package / "msg" / f"{kind}.msg").read_text()
        types.register(get_types_from_msg(text, f"my_boat/msg/{kind}"))
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        path, surge, thrust = folder / "trials" / f"run_{trial}", 0.0, np.float32(0.0)
        path.parent.mkdir(exist_ok=True)
        with Writer(path, version=9) as writer:
            on = {
                kind: writer.add_connection(topic, f"my_boat/msg/{kind}", typestore=types)
                for kind, topic in (("Thrust", "/boat/left"), ("Nav", "/boat/nav"))
            }
            for k in range(300):
                thrust = np.float32(rng.standard_normal()) if k % 7 == 0 else thrust
                surge += 0.2 * (float(thrust) - surge) + 0.01 * rng.standard_normal()
                stamp_ns = START_NS + k * 100_000_000
                for kind, number in (
                    ("Thrust", np.array([thrust, 0.0], np.float32)),
                    ("Nav", surge),
                ):
                    message = types.types[f"my_boat/msg/{kind}"](header(stamp_ns), number)
                    data = types.serialize_cdr(message, f"my_boat/msg/{kind}")
                    writer.write(on[kind], stamp_ns, data)
        [storage] = path.glob("*.db3")
        with closing(sqlite3.connect(storage)) as database:  # as bags before version 6 were
            database.execute("delete from message_definitions")
            database.commit()
    return folder / "trials", package


@pytest.mark.slow
def test_types_that_only_msg_files_define_go_the_whole_way(tmp_path: Path) -> None:
    """Neither type nor name says which number drives; the configuration lies elsewhere."""
    bags, package = boat(tmp_path)
    config = tmp_path / "config" / "robot.yaml"
    config.parent.mkdir()
    said = nlsid("init", config.parent, bags, "--definitions", package)
    settings = load_config(config)
    assert settings.signals.excitation[0].path == "/boat/left:thrust[0]"
    assert settings.signals.response[0].path == "/boat/nav:surge"
    assert said.count("mind: /boat/nav is of type my_boat/msg/Nav") == 1
    assert "run_3" in whole_way(bags, config, tmp_path / "out"), "the test trial is judged"


@pytest.mark.slow
def test_a_folder_of_ros_1_bags_with_numbers_is_one_trial_a_file(tmp_path: Path) -> None:
    types = get_typestore(Stores.ROS1_NOETIC)
    kinds = types.types
    vector = kinds["geometry_msgs/msg/Vector3"]
    (tmp_path / "bags").mkdir()
    for trial in range(3):
        rng = np.random.default_rng(trial)
        with Ros1Writer(tmp_path / "bags" / f"run_{trial}.bag") as writer:
            topics = {
                topic: writer.add_connection(topic, "geometry_msgs/msg/Twist", typestore=types)
                for topic in ("/cmd_vel", "/odom_twist")
            }
            command, speed = 0.0, 0.0
            for k in range(300):
                command = float(rng.uniform(0, 1)) if k % 9 == 0 else command
                speed += 0.2 * (command - speed)
                noisy = speed + 0.01 * float(rng.standard_normal())
                for topic, number in (("/cmd_vel", command), ("/odom_twist", noisy)):
                    twist = kinds["geometry_msgs/msg/Twist"](
                        vector(number, 0.0, 0.0), vector(0.0, 0.0, 0.0)
                    )
                    data = types.serialize_ros1(twist, "geometry_msgs/msg/Twist")
                    writer.write(topics[topic], START_NS + k * 50_000_000, data)
    config = tmp_path / "robot.yaml"
    nlsid(
        "init",
        config.parent,
        tmp_path / "bags",
        "-u",
        "/cmd_vel:linear.x",
        "-y",
        "/odom_twist:linear.x",
    )
    assert load_config(config).split.test == ("run_2",)
    said = whole_way(tmp_path / "bags", config, tmp_path / "out")
    left_out = [line for line in said.splitlines() if line.startswith("not judged: ")]
    assert (
        len(re.findall(r"run_[01]\b", " ".join(left_out)))
        == said.count("run_") - said.count("run_2.bag")
        == 2
    ), "the test trial alone is monitored"


def test_a_delay_that_is_known_is_found(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    command = np.repeat(rng.standard_normal(60), 5)
    speed = np.concatenate([np.zeros(4), command[:-4]])
    found = look([speed_bag(tmp_path / "run", speed, command)])
    best = found.pairs[0]
    assert (best.command.text, best.response.text) == (COMMAND, SPEED)
    assert best.correlation > 0.97
    assert best.delay == pytest.approx(0.1, abs=0.0125)  # four samples of 25 ms
    assert choose(found) == ([SPEED], [COMMAND])
    with pytest.raises(BagError, match="name them with --excitation"):
        choose(found, excitations=["/odom:twist.twist.linear.x"])


def test_one_side_that_is_named_gets_the_other_that_goes_with_it_best() -> None:
    found = look(f1tenth())
    assert [choose(found, responses=[SPEED]), choose(found, excitations=[CMD])] == 2 * [
        ([SPEED], [CMD])
    ]
    assert choose(found, [SPEED], ["/steering_command:position[name=steering]"])[0] == [SPEED]


def test_a_signal_that_is_named_with_operations_has_the_unit_of_their_result(
    tmp_path: Path,
) -> None:
    config = tmp_path / "robot.yaml"
    slope = "|derivative(0.15 s)"  # not the window that is proposed
    moved = "|washout(2 s)"  # in m, but not the position: the name says so
    responses = [f"{POSITION}{slope}", f"{POSITION}|unit(cm){slope}", f"{POSITION}{moved}"]
    excitations = [CMD, f"{CMD} * {POSITION}{slope}"]
    named = [argument for y in responses for argument in ("-y", y)]
    named += [argument for u in excitations for argument in ("-u", u)]
    nlsid("init", config.parent, *f1tenth()[:6], *named)
    signals = load_config(config).signals
    assert [signal.unit for signal in signals.response] == ["m/s", "cm/s", "m"]
    assert [signal.name for signal in signals.response] == [
        "odom position x rate",
        "odom position x rate 2",
        "odom position x washed out",
    ]
    assert [signal.unit for signal in signals.excitation] == ["m/s", ""]
    assert signals.excitation[1].name == "cmd_vel linear x times odom position x rate"
    again = nlsid("init", tmp_path / "b", *f1tenth()[:6], "-u", CMD, "-y", CMD, status=None)
    assert "is named twice" in again


def test_a_measured_effort_drives_where_nothing_commands() -> None:
    """The Schunk arm has one topic; the joint's own rate follows its torque."""
    responses, excitations = choose(look(schunk()))
    assert responses == ["/joint_states:velocity[name=joint_3]"]
    assert excitations == ["/joint_states:effort[name=joint_3]"]


@pytest.mark.slow
def test_a_few_arm_bags_are_sampled_more_slowly_and_go_the_whole_way(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    nlsid("init", config.parent, schunk()[0].parent)
    grid = load_config(config).grid
    assert grid.resample == "last"
    assert grid.period == pytest.approx(10 * 0.004)
    whole_way(schunk()[0].parent, config, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.pictures
def test_two_commands_and_two_responses_on_three_topics_go_the_whole_way(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    steering = "/steering_command:position[name=steering]"
    nlsid(
        "init",
        config.parent,
        f1tenth()[0].parent,
        "-u",
        CMD,
        "-u",
        steering,
        "-y",
        SPEED,
        "-y",
        YAW,
    )
    content = yaml.safe_load(config.read_text())
    assert content["identification"]["model"] == "state_affine"
    assert content["identification"]["input_range"] == [[0.0, 0.4], [-0.2, 0.2]]
    assert content["identification"].get("inputs_degree", 1) in (1, 2, 3)
    assert whole_way(f1tenth()[0].parent, config, tmp_path / "out").count("inside") >= 6


@pytest.mark.slow
def test_a_position_that_adds_up_its_command_is_washed_out(tmp_path: Path) -> None:
    """A cart with friction under a force: no stable model has its position, one has its way."""
    bags, config, position = (
        tmp_path / "bags",
        tmp_path / "robot.yaml",
        "/joint_states:position[name=joint_0]",
    )
    for trial in range(8):
        rng = np.random.default_rng(trial)
        force, speed, way = 0.0, 0.0, 0.0
        with BagWriter(bags / f"run_{trial}") as writer:
            for k in range(400):
                force = float(rng.uniform(-1.0, 1.0)) if k % 10 == 0 else force
                stamp_ns = START_NS + 50_000_000 * k
                measured = way + 1e-4 * rng.standard_normal()
                put(writer, stamp_ns, "/cmd_vel", CMD_TYPE, command(stamp_ns, force))
                put(writer, stamp_ns, "/joint_states", JOINT_TYPE, joints(stamp_ns, [measured]))
                way += 0.05 * speed
                speed += 0.05 * (force - speed)
    said = nlsid("init", config.parent, bags, "-u", CMD, "-y", position)
    [response] = load_config(config).signals.response
    assert (response.path, response.name) == (
        f"{position}|washout(2 s)",
        "joint_states position joint_0 washed out",
    )
    assert f"{position} seems to add up its command, so |washout(2 s) of it is proposed" in said
    assert "named by you" not in said, "nobody named what is proposed"
    assert re.search(r"expect an error in simulation of [0-9.]+ to [0-9.]+ % .*: good", said)
    assert "inside" in whole_way(bags, config, tmp_path / "out")


def followed(command: FloatArray, share: float) -> FloatArray:
    """A first-order lag: from sample to sample it goes this share of the way to the command."""
    return np.asarray(lfilter([share], [1.0, share - 1.0], command))


def stairs(rng: np.random.Generator, low: float, high: float, steps: int, each: int) -> FloatArray:
    """Random commands, each of so many samples."""
    return np.repeat(rng.uniform(low, high, steps), each)


def thrusters(folder: Path, *, trials: int = 4) -> Path:
    """Two unstamped thrusters of which the sum is the speed's command, and the noise is small."""
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        left, right = (stairs(rng, 0.0, 1.0, 20, 15) for _ in range(2))
        speed = followed(left + right, 0.15) + 0.005 * rng.standard_normal(len(left))
        values = {"/left_cmd": left, "/right_cmd": right, "/speed": speed}
        number_bag(folder / f"run_{trial}", values, period=0.1)
    return folder


@pytest.mark.slow
def test_commands_that_have_ended_are_not_held(tmp_path: Path) -> None:
    """A base that stops by itself 0.5 s after the last command of a stream, at the bag's end."""
    bags, config = tmp_path / "bags", tmp_path / "robot.yaml"
    for trial in range(4):
        rng = np.random.default_rng(trial)
        command = stairs(rng, 0.5, 1.0, 13, 20)[:250]
        command[206:] = 0.0
        speed = followed(command, 0.2) + 0.005 * rng.standard_normal(250)
        heard = np.where(np.arange(250) > 200, np.nan, command)
        number_bag(bags / f"run_{trial}", {"/speed": speed, "/cmd": heard}, period=0.1)
    said = nlsid("init", config.parent, bags, "-u", "/cmd:data", "-y", "/speed:data")
    assert "commands end up to 4.9 s before the responses do" in said
    assert re.search(r"expect an error in simulation of [0-9.]+ to [0-9.]+ % .*: good", said)
    [found] = check_fitness(
        [bags / "run_0"], excitations=["/cmd:data"], responses=["/speed:data"], clock="log"
    )
    commands = [finding.what for finding in found.findings if finding.check == "commands"]
    assert commands[0].endswith("one held for at most 0.1 s (grid.hold)"), "as init says"
    assert "ends 4.9 s before the responses do" in commands[1]
    grid = load_config(config).grid
    assert grid.hold is None
    assert grid.split_gaps
    nlsid("identify", tmp_path / "out", bags, "--config", config)
    trained = decoded((tmp_path / "out" / documents.TRIALS).read_bytes(), source="it")["training"]
    assert all(trial.u.min() > 0.4 for trial in trained)


def lagging(folder: Path, *, period: float, trials: int = 3) -> Path:
    """Bags of a number `/b` that follows `/a` with a lag, on topics that say nothing of a role."""
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        drives = stairs(rng, -1.0, 1.0, 20, 15)
        answers = followed(drives, 0.2) + 0.01 * rng.standard_normal(300)
        number_bag(folder / f"run_{trial}", {"/a": drives, "/b": answers}, period=period)
    return folder


@pytest.mark.parametrize(
    ("period", "named", "question"),
    [
        (0.02, ("-u", "/a:data", "-y", "/b:data"), ""),
        (0.02, ("-u", "/b:data", "-y", "/a:data"), "are they swapped? /b:data follows /a:data by"),
        (20.0, ("-u", "/a:data", "-y", "/b:data"), ""),
    ],
)
def test_what_seems_wrong_is_left_to_a_person(
    tmp_path: Path, period: float, named: tuple[str, ...], question: str
) -> None:
    bags = lagging(tmp_path / "bags", period=period)
    said = nlsid("init", tmp_path, bags, *named, status=None if question else 0)
    assert question in said
    head = (tmp_path / "robot.yaml").read_text().partition("\nrobot: ")[0]
    written = " ".join(head.replace("#", " ").split())
    slow = period > 1.0
    assert written.count("Mind: ") == 1 + bool(question) + slow, "and that they have no stamps"
    assert ("20 s apart, 0.05 Hz; if times in milliseconds" in written) is slow
    assert question in written
    assert ("if the question above is answered" in written) is bool(question)


def test_a_command_that_by_its_type_is_measured_is_asked_about(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    speeds = [np.cumsum(rng.standard_normal(100)) for _ in range(2)]
    bag = speed_bag(tmp_path / "run", *speeds)
    said = nlsid("init", tmp_path / "a", bag, "-u", SPEED, "-y", CMD, status=None)
    assert f"by type and name {CMD} drives and {SPEED} is measured" in said


@pytest.mark.parametrize("named", [("-u", CMD, "-y", SPEED), ("-u", CMD), ("-y", SPEED), ()])
def test_a_command_that_never_varies_is_an_answer_and_no_configuration(
    tmp_path: Path, named: tuple[str, ...]
) -> None:
    speeds = np.cumsum(np.random.default_rng(0).standard_normal((2, 200)), axis=1)
    for k, speed in enumerate(speeds):
        speed_bag(tmp_path / "bags" / f"run_{k}", speed, np.full(200, 0.3))
    config = tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, tmp_path / "bags", *named, status=1)
    assert said.count("nothing was written: ") == 1
    assert CMD in said
    assert not config.exists()


def stamped(bags: Path, steps_ms: FloatArray) -> None:
    """Three runs of a speed that follows its command, with these 300 steps between stamps."""
    stamps = START_NS + np.cumsum(1_000_000 * steps_ms.astype(int))
    for k in range(3):
        rng = np.random.default_rng(k)
        command = stairs(rng, -1.0, 1.0, 20, 15)
        speed = followed(command, 0.2) + 0.01 * rng.standard_normal(300)
        speed_bag(bags / f"run_{k}", speed, command, stamps_ns=stamps.tolist())


@pytest.mark.slow
def test_stamps_that_jitter_by_forty_percent_of_a_period_are_judged(tmp_path: Path) -> None:
    """Steps of 4 to 36 ms: on a grid of 20 ms a tenth of the samples were said to be filled in."""
    stamped(tmp_path / "bags", 20.0 + np.diff(np.random.default_rng(0).uniform(-8.0, 8.0, 301)))
    nlsid("init", tmp_path, tmp_path / "bags", "-u", CMD, "-y", SPEED)
    assert "inside" in whole_way(tmp_path / "bags", tmp_path / "robot.yaml", tmp_path / "out")


@pytest.mark.slow
def test_a_period_is_one_that_the_stamps_of_a_whole_run_keep_to(tmp_path: Path) -> None:
    """Steps of 20, 22 and 22 ms in turn: on a grid of the median a monitor judges 4 samples."""
    stamped(tmp_path / "bags", np.array([20.0, 22.0, 22.0] * 100))
    config = tmp_path / "robot.yaml"
    nlsid("init", config.parent, tmp_path / "bags", "-u", CMD, "-y", SPEED)
    grid = load_config(config).grid
    assert grid.period == pytest.approx(0.0213333, rel=1e-3)
    assert grid.resample == "none"
    whole_way(tmp_path / "bags", config, tmp_path / "out")
    median = config.read_text().replace(f"period: {grid.period}", "period: 0.022")
    config.write_text(median)
    out = tmp_path / "median"
    told = "run_2: its stamps stray from a grid of 0.022 s, so that a monitor begins 300 new runs"
    assert told in nlsid("identify", out, tmp_path / "bags", "--config", config)
    refused = nlsid("funnel", out, "--config", config, status=None)
    assert "a monitor would judge little" in refused
    assert not (out / "funnel.json").exists()


def two_axes(folder: Path) -> None:
    """Two numbers that each follow a command of their own, and one that stands still."""
    rng = np.random.default_rng(7)
    a, b = (stairs(rng, -1.0, 1.0, 20, 20) for _ in range(2))
    values = {"/state_c": np.ones(400), "/cmd_a": a, "/cmd_b": b}
    values |= {"/speed_a": followed(a, 0.2), "/speed_b": followed(b, 0.2)}
    number_bag(folder, values, period=0.1)


def test_each_response_that_is_named_gets_the_command_that_it_follows(tmp_path: Path) -> None:
    two_axes(tmp_path / "bag")
    found = look([tmp_path / "bag"])
    named = ["/speed_b:data", "/speed_a:data"]
    assert choose(found, named) == (named, ["/cmd_b:data", "/cmd_a:data"])
    with pytest.raises(BagError, match="/speed_c:data follows no command"):
        choose(found, ["/speed_c:data"])


@pytest.fixture(scope="module")
def axes(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The configuration that init writes for two axes, and what it says."""
    folder = tmp_path_factory.mktemp("axes")
    two_axes(folder / "bag")
    return folder / "robot.yaml", nlsid("init", folder, folder / "bag")


def test_responses_like_the_proposed_one_are_said_and_how_they_are_added(
    axes: tuple[Path, str],
) -> None:
    config, said = axes
    [chosen] = load_config(config).signals.response
    other = "b" if chosen.path.startswith("/speed_a") else "a"
    assert f"there are others like it: /speed_{other}:data follows /cmd_{other}:data (+" in said
    options = "-y '/speed_a:data' -y '/speed_b:data' -u '/cmd_a:data' -u '/cmd_b:data'"
    assert f"run init with {options}." in said


def test_many_bags_are_said_as_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "two axes"
    bags = [folder / f"run_{k}" for k in range(4)]
    for bag in bags:
        two_axes(bag)
    assert said_briefly(bags) == f"'{folder}'", "it can be pasted"
    assert said_briefly(bags[:2]) == f"'{bags[0]}' '{bags[1]}'"
    two_axes(folder / "other")
    assert said_briefly(bags) == "BAGS"


def test_a_robot_that_never_moves_is_named_and_not_its_command(tmp_path: Path) -> None:
    commands = np.repeat(np.random.default_rng(2).uniform(-1.0, 1.0, (20, 2)), 10, axis=0)
    kind = "geometry_msgs/msg/Twist"
    with BagWriter(tmp_path / "bag") as writer:
        for k, (forward, turn) in enumerate(commands):
            at = START_NS + k * 25_000_000
            message = twist(forward)
            message.angular.z = turn + 0.5 * forward
            put(writer, at, "/cmd_vel", kind, serialised(kind, message))
            put(writer, at, "/odom", "nav_msgs/msg/Odometry", odometry(at, 0.0))
    with pytest.raises(BagError, match=r"no number follows another; .*always the same: /odom:"):
        choose(look([tmp_path / "bag"]))


@pytest.mark.slow
def test_a_compass_is_unwrapped_and_goes_with_its_course(tmp_path: Path) -> None:
    """Degrees that begin again at 360, without a unit in the type."""
    rng = np.random.default_rng(3)
    for name in ("a", "b"):
        course = stairs(rng, -30.0, 30.0, 15, 20)
        heading = followed(course, 0.2) - 0.01 + 0.1 * rng.standard_normal(300)
        values = {"/course": course % 360.0, "/heading": heading % 360.0}
        number_bag(tmp_path / name, values, period=0.1)
    u, y = (f"/{name}:data|unit(deg)|unwrap" for name in ("course", "heading"))
    assert {y, u} <= {each.text for each in look([tmp_path / "a"]).candidates}
    said = nlsid("init", tmp_path, tmp_path / "a", tmp_path / "b", "-u", u, "-y", y)
    promised = re.search(
        r"of ([0-9.]+) to ([0-9.]+) % on stretches of the only excitation .*: good", said
    )
    assert promised
    assert float(promised[1]) < float(promised[2]) < 2.0
    assert "if a trial begins near half a turn" in said


@pytest.mark.slow
def test_header_stamps_that_are_all_zero_are_not_taken(tmp_path: Path) -> None:
    """A publisher that does not fill them in: identification would refuse them."""
    rng = np.random.default_rng(4)
    for name in ("a", "b"):
        u = np.repeat(rng.uniform(-1.0, 1.0, 20), 10)
        y = np.convolve(u, 0.2 * 0.8 ** np.arange(60))[: len(u)]
        y += 0.01 * rng.standard_normal(len(y))
        speed_bag(tmp_path / name, y, u, stamps_ns=[0] * len(u))
    config = tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, tmp_path / "a", tmp_path / "b", "-u", CMD, "-y", SPEED)
    assert load_config(config).clock == "log"
    assert "/odom (nav_msgs/msg/Odometry) has header stamps that are all 0" in said


@pytest.mark.slow
def test_the_likeliest_signals_are_several_commands_where_one_alone_says_little(
    tmp_path: Path,
) -> None:
    bags, config = thrusters(tmp_path / "bags"), tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, bags)
    assert {signal.path for signal in load_config(config).signals.excitation} == {
        "/left_cmd:data",
        "/right_cmd:data",
    }
    [without] = re.findall(r"without it models are off by (\S+) %", said)
    assert float(without) > 50.0
    assert "nothing that was tried" not in said
    named = tmp_path / "named" / "robot.yaml"  # who names one gets that one, and reads of the other
    said = nlsid("init", named.parent, bags, "-u", "/left_cmd:data")
    assert len(load_config(named).signals.excitation) == 1
    assert "it follows /right_cmd:data" in said


def test_an_existing_file_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("mine")
    said = nlsid("init", tmp_path, f1tenth()[0].parent, status=None)
    assert "exists already" in said
    assert (tmp_path / "robot.yaml").read_text() == "mine"


def test_bags_in_which_nothing_moves_are_refused(tmp_path: Path) -> None:
    still = speed_bag(tmp_path / "still", np.full(50, 0.3), np.full(50, 0.2))
    with pytest.raises(DataError, match="no number varies in still"):
        look([still])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "seconds"),
    [
        ("ur10_panda/ur10_exciting_trajectory.db3", 5.51),
        ("cougars_auv/SO_lastbag_mcap", 24.0),
    ],
)
@pytest.mark.pictures
def test_other_robots_go_the_whole_way_unedited(tmp_path: Path, robot: str, seconds: float) -> None:
    """Each is one recording, which is cut into parts first, as `init` says it should be."""
    bag, parts = SHARED / robot, tmp_path / "parts"
    if not bag.exists():
        pytest.skip(f"needs {robot} in ../shared/data")
    assert "mind: one bag" in nlsid("init", tmp_path / "one", bag)
    parts.mkdir()
    nlsid("bag", "convert", bag, "--out", parts / "part", "--every", seconds)
    config = tmp_path / "robot.yaml"
    nlsid("init", config.parent, parts)
    assert load_config(config).clock == "header"
    whole_way(parts, config, tmp_path / "out")


@pytest.mark.slow
def test_the_slope_that_is_proposed_fits_the_rate_of_a_slow_position(tmp_path: Path) -> None:
    bag, level = tmp_path / "tank", 0.0
    pumped = np.repeat(np.random.default_rng(2).uniform(0.0, 1.0, 30), 10)
    with BagWriter(bag) as writer:
        for k, value in enumerate(pumped.tolist()):
            stamp = START_NS + k * 500_000_000
            level += 0.1 * (value - level)
            put(writer, stamp, "/pump", CMD_TYPE, command(stamp, value))
            put(writer, stamp, "/level", JOINT_TYPE, joints(stamp, [level]))
    said = nlsid(
        "init", tmp_path, bag, "-u", "/pump:twist.linear.x", "-y", "/level:position[name=joint_0]"
    )
    assert "looking into 1 bag\n" in said
    assert "take |derivative(2.5 s) of it" in " ".join(said.split())


def heater(folder: Path, *, trials: int, kelvin: int = -1, motions: int = 0) -> Path:
    """Trials of a slow heater, one sample a second, on topics without stamps.

    kelvin: the trial that is recorded in K and not in degC. motions: how many powers there are,
    taken in turn (0: another one each time).
    """
    for trial in range(trials):
        powers = np.random.default_rng(trial % motions + 90 if motions else trial + 90)
        power = stairs(powers, 0.0, 1.0, 10, 15)
        noise = 0.05 * np.random.default_rng(trial).standard_normal(150)
        zero = 293.15 if trial == kelvin else 20.0
        temperature = zero + followed(40.0 * power, 0.1) + noise
        values = {"/power": power, "/temperature": temperature}
        number_bag(folder / f"run_{trial:02d}", values, period=1.0)
    return folder


SLOW = ("-u", "/power:data", "-y", "/temperature:data")


@pytest.mark.slow
def test_a_slow_robot_is_set_up_by_the_names_of_its_topics(tmp_path: Path) -> None:
    bags, config = heater(tmp_path / "bags", trials=5), tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, bags, *SLOW)
    settings = load_config(config)
    assert settings.grid.period == 1.0
    signals = (*settings.signals.excitation, *settings.signals.response)
    assert [signal.name for signal in signals] == ["power", "temperature"]
    assert "another unit" not in said


@pytest.mark.slow
def test_a_trial_in_another_unit_is_named(tmp_path: Path) -> None:
    bags = heater(tmp_path / "bags", trials=5, kelvin=2)
    said = nlsid("init", tmp_path, bags, *SLOW)
    assert said.count("is it in another unit") == 1
    assert "mind: run_02: temperature is 29" in said


@pytest.mark.slow
def test_repeated_motions_are_in_every_part_of_the_split(tmp_path: Path) -> None:
    """Two motions in turn, ten bags: every fifth by name would test one of them twice as often."""
    bags, config = heater(tmp_path / "bags", trials=10, motions=2), tmp_path / "robot.yaml"
    nlsid("init", config.parent, bags, *SLOW)
    split = load_config(config).split
    assert (split.calibration, split.test) == (("run_04", "run_05"), ("run_08", "run_09"))


def test_what_identification_will_refuse_is_said_with_its_reason(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, *f1tenth()[:6], "-u", CMD, "-y", SPEED)
    [reason] = re.findall(r"identification will refuse \((.*?)\); a response", said)
    assert "has rank 2" in reason
    refused = nlsid("identify", tmp_path, *f1tenth()[:6], "--config", config, status=None)
    assert reason in refused


@pytest.mark.slow
def test_lags_are_tried_on_all_trials_where_a_part_of_them_is_too_little(tmp_path: Path) -> None:
    """The trials that are not held back stand still: only with the moving one is there a model."""
    rng = np.random.default_rng(0)
    for run in range(3):
        given = stairs(rng, 0.1, 0.9, 30, 10) if run else np.full(300, 0.4)
        speeds = 0.4 + followed(given - 0.4, 0.2)
        speed_bag(tmp_path / f"run_{run}", speeds + 1e-3 * rng.standard_normal(300), given)
    config = tmp_path / "robot.yaml"
    said = nlsid("init", config.parent, tmp_path, "-u", CMD, "-y", SPEED)
    assert "will refuse" not in said
    assert "the model is a first guess" in said
    nlsid("identify", tmp_path / "out", tmp_path, "--config", config)


def test_one_command_goes_from_bags_to_a_checked_design_or_says_what_to_decide(
    tmp_path: Path,
) -> None:
    bags = lagging(tmp_path / "bags", period=0.02, trials=4)
    said = nlsid("learn", bags, "--out", tmp_path / "out", "-u", "/a:data", "-y", "/b:data")
    assert said.count("PROVED") == 2
    [(low, high)] = re.findall(r"simulation of ([\d.]+) to ([\d.]+) % on excitations", said)
    assert float(low) < 3.3 < float(high) * 1.5, "the noise is 3 % of the spread"
    assert {"robot.yaml", "design.html"} < {path.name for path in (tmp_path / "out").iterdir()}
    written = (tmp_path / "out" / "robot.yaml").read_text()
    assert float(written.rpartition("safety_factor: ")[2]) >= 2.4, "one trial sets the level"
    assert "are they swapped?" in nlsid(
        "learn", bags, "--out", tmp_path / "b", "-u", "/b:data", "-y", "/a:data", status=None
    )


def test_a_model_without_a_tube_makes_way_for_the_next_best() -> None:
    rng, trials = np.random.default_rng(0), []
    for name in "abc":
        u = np.repeat(rng.standard_normal(60), 5)
        y = lfilter([0.0, 0.2], [1.0, -0.8], u) + 0.01 * rng.standard_normal(300)
        trials.append(Trajectory(t=0.1 * np.arange(300), y=y, u=u, name=name))
    held_out = HeldOut.of(Dataset(tuple(trials)))
    glances = [held_out.glance(Attempt(Polynomial(lags), LeastSquares())) for lags in (1, 2)]
    rows = tuple(map(held_out.judged, glances))
    choice = Choice(held_out, rows)
    best, other = (row.attempt for row in choice.ranked)
    proposal = Proposal({"identification": {}}, choice=choice)
    assert take_next(proposal, "too wide") == str(other)
    assert proposal.content["identification"] == section_of(other, held_out.data)
    assert f"{best} has no tube: too wide" in proposal.why["model"]
    assert not take_next(proposal, "too wide"), "nothing is left"
