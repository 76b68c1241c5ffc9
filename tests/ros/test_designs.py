"""Nothing is used that the kernel has not proved here: bundles, true, forged and hostile."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticStatus
from std_msgs.msg import String
from std_srvs.srv import Trigger

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files
from bags.designs import documents
from bags.designs.bundle import MAX_BYTES, Bundle
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_ros import qos
from tests.ros.processes import Bench, refusal, ros_test
from tests.ros.robot import GOOD, Robot

pytestmark = ros_test
NODES = ("funnel_monitor", "tracking_controller")


@pytest.fixture
def used(robot: Robot) -> Robot:
    """A robot with a monitor and a controller that listen to its bundle."""
    robot.start("tracking_controller", highest=0.4, stale_after=5.0)
    robot.watched(stale_after=5.0, allow_old_stamps=True)
    robot.ready()
    robot.hears("idle", "tracking_controller")
    return robot


@pytest.fixture(scope="session")
def wider(funnel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of another proved funnel of the same model."""
    folder = tmp_path_factory.mktemp("wider")
    shutil.copytree(funnel.parent, folder, dirs_exist_ok=True)
    config = load_config(config_file("f1tenth.yaml"))
    assert config.funnel is not None
    changed = config.funnel.model_copy(update={"safety_factor": 2.0})
    settings = config.model_copy(update={"funnel": changed})
    design_funnel_files(folder / documents.MODEL, settings, folder)
    return folder


def start(robot: Robot) -> Trigger.Response:
    """The controller's answer to ~/start."""
    return robot.call("/tracking_controller/start")


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
        robot.hears(because, name)
        assert robot.levels[name] == DiagnosticStatus.ERROR
    answer = start(robot)
    assert not answer.success
    assert "refused" in answer.message


def test_a_forged_policy_is_refused_and_moves_nothing(used: Robot) -> None:
    robot = used
    robot.publish(with_policy(robot.bundle, stronger))
    refused(robot, "design refused: policy.json is not the policy this proof is about")
    robot.publish(robot.bundle)
    for name in NODES:
        robot.spin_until(lambda name=name: robot.levels[name] != DiagnosticStatus.ERROR)  # type: ignore[misc]
    assert start(robot).success


@pytest.mark.parametrize("missing", ["proof", "policy", "model", "funnel"])
def test_a_design_without_one_of_its_files_is_refused(used: Robot, missing: str) -> None:
    robot = used
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
def test_what_is_no_bundle_is_refused_by_name(used: Robot, text: str, because: str) -> None:
    robot = used
    robot.latched.publish(String(data=text))
    refused(robot, because)


def test_a_second_publisher_is_refused_and_the_run_goes_on_as_it_was(used: Robot) -> None:
    robot = used
    robot.drive(GOOD)
    robot.hears("inside")
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
def test_only_the_expected_funnel_is_used(funnel: Path, name: str, robot: Robot) -> None:
    own, other = files.digest(funnel.read_bytes()), "0" * 64
    robot.start(name, highest=0.4, expected_digest=own)
    robot.start(name, highest=0.4, expected_digest=f"'{other}'", __node="picky")
    robot.hears(f"not the expected sha256:{other}", "picky")
    assert robot.levels["picky"] == DiagnosticStatus.ERROR
    robot.spin_until(lambda: says(robot, name, "design", "PROVED"))


def test_an_older_design_is_not_taken_after_the_one_in_use_was_published_again(
    used: Robot, wider: Path
) -> None:
    """The older one is proved too, but its check takes long enough to be overtaken."""
    robot, other = used, Bundle.load(wider / documents.FUNNEL)
    proof = other.contents["proof"].decode().replace('"proof":', " " * 3 * 10**6 + '"proof":')
    name, own = "tracking_controller", robot.bundle.digest
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


def test_a_control_loop_goes_on_while_a_proof_is_checked(used: Robot) -> None:
    """The proof's numbers are padded so that deciding takes much longer than a sample."""
    robot = used
    robot.drive(GOOD)
    robot.hears("inside")
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


DAMAGE: dict[str, Callable[[Path], object]] = {
    "forged": lambda path: path.write_text(path.read_text().replace("1.5", "1.4")),
    "no proof": lambda path: path.with_name(documents.FUNNEL_PROOF).unlink(),
    "no funnel": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_the_publisher_refuses_what_is_not_proved(
    funnel: Path, tmp_path: Path, damage: str
) -> None:
    path = tmp_path / "damaged" / funnel.name
    shutil.copytree(funnel.parent, path.parent)
    DAMAGE[damage](path)
    assert "not published, not proved" in refusal("nlsid_ros.funnel_publisher", funnel=path)


def test_the_publisher_publishes_another_funnel_when_told_to_and_none_that_is_forged(
    bench: Bench, funnel: Path, wider: Path, tmp_path: Path
) -> None:
    heard: list[str] = []
    name, path = "funnel_publisher", tmp_path / "used" / funnel.name
    shutil.copytree(funnel.parent, path.parent)
    bench.listen(
        String,
        f"/{name}/design",
        lambda message: heard.append(Bundle.parse(message.data).digest),
        qos.DOCUMENT,
    )
    bench.start(name, funnel=path)
    bench.spin_until(lambda: len(heard) == 1)
    assert bench.set(name, "funnel", str(wider / funnel.name)) == ""
    bench.spin_until(lambda: heard[-1] == files.digest((wider / funnel.name).read_bytes()))
    count, design = len(heard), files.load_document(path)
    forged = design | {"tubes": [design["tubes"][0] | {"level": 2.0}]}
    files.write_document(path, forged)
    assert "not the funnel this proof is about" in bench.set(name, "funnel", str(path))
    assert len(heard) == count
    assert bench.set(name, "funnel", str(funnel)) == ""
    bench.spin_until(lambda: heard[-1] == heard[0])
