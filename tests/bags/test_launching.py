"""The launch files, as `nlsid run` reads them: nothing in them that does not exist."""

import itertools
import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

from bags.chain.shipped import shipped_file
from bags.commands.launching import WORKFLOWS, LaunchFile
from nlsid_core.errors import DataError
from tests.verbs import nlsid

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "launch").glob("*.xml"))


def flags(command: list[str], flag: str) -> dict[str, str]:
    """What `-p` or `-r` gives in a command line, by name."""
    given = [value for name, value in itertools.pairwise(command) if name == flag]
    return {name: value for name, _, value in (text.partition(":=") for text in given)}


def commands(name: str, *given: str) -> dict[str, list[str]]:
    launch = LaunchFile(shipped_file("launch", f"{name}.launch.xml"))
    return {command[2].partition(".")[2]: command for command in launch.commands(given)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_node_and_parameter_in_a_launch_file_exists(path: Path) -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    page = (ROOT / "docs" / "nodes.md").read_text()
    nodes = list(ElementTree.parse(path).getroot().iter("node"))
    assert nodes
    for node in nodes:
        name = node.attrib["exec"]
        assert name in scripts
        assert node.attrib["pkg"] == "nlsid"
        section = page.split(f"## {name}\n")[1].split("\n## ")[0]
        named = {each.attrib["name"] for each in node.iter("param") if "name" in each.attrib}
        for parameter in named - {"use_sim_time"}:  # which every node of ROS has
            assert re.search(rf"^\| `{parameter}`", section, re.MULTILINE)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_argument_is_described_and_used_and_nothing_else_is(path: Path) -> None:
    launch, text = LaunchFile(path), path.read_text()
    assert all(argument.description for argument in launch.arguments)
    assert {a.name for a in launch.arguments} == set(re.findall(r"\$\(var (\w+)\)", text))


def test_arguments_fill_parameters_names_and_remappings_and_conditions_choose_nodes() -> None:
    given = ["funnel:=f.json", "highest:=0.4", "namespace:=/a", "odom:=/a/odom"]
    without = commands("control", *given)
    assert set(without) == {"funnel_publisher", "tracking_controller", "funnel_monitor"}
    within = commands("control", *given, "plant:=true", "model:=m.json")
    assert set(within) - set(without) == {"plant"}
    assert flags(within["plant"], "-p")["model"] == "m.json"
    assert flags(within["tracking_controller"], "-p")["highest"] == "0.4"
    renamed = flags(within["funnel_monitor"], "-r")
    assert renamed.items() >= {("__ns", "/a"), ("odom", "/a/odom"), ("cmd_vel", "cmd_vel")}
    slashed = commands("monitor", "funnel:=f.json", "namespace:=fleet/unit_7/")
    assert flags(slashed["funnel_monitor"], "-r")["__ns"] == "/fleet/unit_7"
    all_alike = commands("monitor", "funnel:=f.json", "/imu:=/a/imu", "use_sim_time:=true")
    for command in all_alike.values():
        assert flags(command, "-r")["/imu"] == "/a/imu"
        assert flags(command, "-p")["use_sim_time"] == "true"
        assert "--params-file" in command
        assert "--log-level" in command


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ([], "funnel missing; the arguments of monitor.launch.xml:"),
        (["funnel:=f.json", "funel:=g.json"], "'funel:=g.json' is not one of the arguments"),
        (["funnel=f.json"], "'funnel=f.json' is not one of the arguments"),
    ],
)
def test_what_is_missing_or_not_known_is_named(given: list[str], says: str) -> None:
    with pytest.raises(DataError, match=re.escape(says)):
        commands("monitor", *given)


def test_what_only_ros_launch_understands_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.launch.xml"
    path.write_text('<launch><include file="x"/><node><env name="A" value="1"/></node></launch>')
    with pytest.raises(DataError, match=r"<env>, <include> is for `ros2 launch` only"):
        LaunchFile(path)


def test_run_without_a_workflow_lists_every_one_with_its_arguments() -> None:
    pytest.importorskip("rclpy", reason="needs rclpy (extra `ros`)")
    said = nlsid("run", status=2)
    for name in WORKFLOWS:
        assert f"{name}.launch.xml:" in said


def test_run_with_a_workflow_that_does_not_exist_names_those_that_do() -> None:
    pytest.importorskip("rclpy")
    said = nlsid("run", "../monitor", status=2)
    assert "no workflow '../monitor'; there are: monitor" in said
