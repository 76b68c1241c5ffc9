"""Nothing is used that the kernel has not proved here: bundles, true, forged and hostile."""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.designs.bundle import MAX_BYTES, Bundle
from bags.samples import f1tenth
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.progress import silent
from nlsid_ros import qos
from tests.ros.processes import call, node_here, process, ros_test, stop
from tests.ros.robot import GOOD, MONITOR, Robot

pytestmark = ros_test
CONTROLLER = "nlsid_ros.tracking_controller"
NODES = ("funnel_monitor", "tracking_controller")


@pytest.fixture
def robot(funnel: Path) -> Iterator[Robot]:
    """A robot with a monitor and a controller that listen to its bundle."""
    with ExitStack() as stack:
        node, spin_until = stack.enter_context(node_here("test_robot"))
        stack.enter_context(process(MONITOR, stale_after=5.0, allow_old_stamps=True))
        stack.enter_context(process(CONTROLLER, highest=0.4, stale_after=5.0))
        robot = Robot(node, spin_until, funnel.parent)
        robot.ready()
        robot.spin_until(lambda: robot.has_said("idle", "tracking_controller"))
        yield robot


def start(robot: Robot) -> Trigger.Response:
    """The controller's answer to ~/start."""
    return call(robot.node, robot.spin_until, "/tracking_controller/start")


def with_policy(bundle: Bundle, change: Callable[[Json], Json]) -> Bundle:
    """The bundle with another policy, and with a funnel that says it was made for that one."""
    policy = files.encode(change(files.parse_document(bundle.contents["policy"])))
    funnel = files.parse_document(bundle.contents["funnel"])
    [stated] = [
        key for key, value in funnel.items() if value == files.digest(bundle.contents["policy"])
    ]
    made = files.encode(funnel | {stated: files.digest(policy)})
    return Bundle({**bundle.contents, "policy": policy, "funnel": made})


def stronger(policy: Json) -> Json:
    """The policy with twice the gain."""
    return policy | {"K": [[2.0 * entry for entry in row] for row in policy["K"]]}


def says(robot: Robot, node: str, key: str, text: str) -> bool:
    """Whether the node's newest diagnostics have it."""
    heard = robot.said.get(node, [])
    return bool(heard) and text in heard[-1][1][key]


def refused(robot: Robot, because: str) -> None:
    """Both nodes say that they refuse, at ERROR, and no run can be begun."""
    for name in NODES:
        robot.spin_until(lambda name=name: robot.has_said(because, name))  # type: ignore[misc]
        assert robot.levels[name] == DiagnosticStatus.ERROR
    answer = start(robot)
    assert not answer.success
    assert "refused" in answer.message


def test_a_forged_policy_is_refused_and_moves_nothing(robot: Robot) -> None:
    robot.publish(with_policy(robot.bundle, stronger))
    refused(robot, "design refused: policy.json is not the policy this proof is about")
    robot.publish(robot.bundle)
    for name in NODES:
        robot.spin_until(lambda name=name: robot.levels[name] != DiagnosticStatus.ERROR)  # type: ignore[misc]
    assert start(robot).success


@pytest.mark.parametrize("missing", ["proof", "policy", "model", "funnel"])
def test_a_design_without_one_of_its_files_is_refused(robot: Robot, missing: str) -> None:
    robot.publish(Bundle({role: c for role, c in robot.bundle.contents.items() if role != missing}))
    refused(robot, "design refused")


@pytest.mark.parametrize(
    ("text", "because"),
    [
        ("[" * 100_000, "not a valid document"),
        ("x" * (MAX_BYTES + 1), f"at most {MAX_BYTES} are read"),
        (json.dumps({"format": "nlsid/bundle", "version": 2, "files": {"proof": 7}}), "texts"),
        (json.dumps({"format": "nlsid/model", "version": 2}), "expected 'nlsid/bundle'"),
    ],
    ids=["nested", "huge", "numbers", "another document"],
)
def test_what_is_no_bundle_is_refused_by_name(robot: Robot, text: str, because: str) -> None:
    robot.latched.publish(String(data=text))
    refused(robot, because)


def test_a_second_publisher_is_refused_and_the_run_goes_on_as_it_was(robot: Robot) -> None:
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))
    second = robot.node.create_publisher(String, "/funnel_publisher/design", qos.DOCUMENT)
    second.publish(String(data=with_policy(robot.bundle, stronger).text()))
    refused(robot, "/funnel_publisher/design has 2 publishers")
    robot.drive([10, 11, 12])
    said = robot.said["funnel_monitor"][-1][0]
    assert said.startswith("inside")
    assert "design refused" in said
    robot.node.destroy_publisher(second)
    for name in NODES:
        robot.spin_until(lambda name=name: robot.levels[name] != DiagnosticStatus.ERROR)  # type: ignore[misc]
    assert start(robot).success


@pytest.mark.parametrize("name", NODES)
def test_only_the_expected_funnel_is_used(funnel: Path, name: str) -> None:
    own = files.digest(funnel.read_bytes())
    other = "0" * 64
    with (
        node_here("test_robot") as (node, spin_until),
        process(f"nlsid_ros.{name}", highest=0.4, expected_digest=own) as good,
        process(f"nlsid_ros.{name}", highest=0.4, expected_digest=f"'{other}'", __node="picky"),
    ):
        robot = Robot(node, spin_until, funnel.parent)
        spin_until(lambda: robot.has_said(f"not the expected sha256:{other}", "picky"))
        assert robot.levels["picky"] == DiagnosticStatus.ERROR
        spin_until(lambda: robot.has_said("", name))
        spin_until(lambda: any("PROVED" in values["design"] for _, values in robot.said[name]))
        stop(good)


def test_an_older_design_is_not_taken_after_the_one_in_use_was_published_again(
    robot: Robot, tmp_path: Path
) -> None:
    """The older one is proved too, but its check takes long enough to be overtaken."""
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, tmp_path, progress=silent)
    assert config.funnel is not None
    wider = config.funnel.model_copy(update={"safety_factor": 2.0})
    design_funnel_files(
        tmp_path / documents.MODEL, config.model_copy(update={"funnel": wider}), tmp_path
    )
    other = Bundle.load(tmp_path / documents.FUNNEL)
    proof = other.contents["proof"].decode().replace('"proof":', " " * 3 * 10**6 + '"proof":')
    name = "tracking_controller"
    own = robot.bundle.digest
    robot.spin_until(lambda: says(robot, name, "funnel", own))
    assert own != other.digest
    robot.said.clear()
    robot.publish(Bundle({**other.contents, "proof": proof.encode()}))
    for node in NODES:
        robot.spin_until(lambda node=node: says(robot, node, "design", "checking the proof"))  # type: ignore[misc]
    robot.publish(robot.bundle)
    for node in NODES:
        robot.spin_until(lambda node=node: says(robot, node, "design", "PROVED"))  # type: ignore[misc]
    robot.publish(with_policy(robot.bundle, stronger))  # whose check begins after the others'
    refused(robot, "design refused: policy.json is not the policy this proof is about")
    assert {values["funnel"] for _, values in robot.said[name]} == {own}
    robot.publish(other)  # it can be taken
    robot.spin_until(lambda: says(robot, name, "funnel", other.digest))


def test_a_control_loop_goes_on_while_a_proof_is_checked(robot: Robot) -> None:
    """The proof's numbers are padded so that deciding takes much longer than a sample."""
    robot.drive(GOOD)
    robot.spin_until(lambda: robot.has_said("inside"))
    robot.said.clear()
    proof = robot.bundle.contents["proof"].decode().replace('"proof":', " " * 10**6 + '"proof":')
    padded = Bundle({**robot.bundle.contents, "proof": proof.encode()})
    robot.publish(padded)
    k = GOOD[-1]

    def said(text: str) -> bool:
        heard = robot.said.get("funnel_monitor", [])
        return any(text in values["design"] for _, values in heard)

    robot.spin_until(lambda: said("checking the proof"))
    while not said("PROVED"):
        k += 1
        robot.drive([k])
    texts = {text.partition("; /cmd_vel")[0] for text, _ in robot.said["funnel_monitor"]}
    over = "unknown: the proof covers 117 samples; they are over"  # on a machine that is busy
    assert "inside" in texts
    assert texts <= {"inside", over}, "it went on all the time"
