"""Identification as a service, a funnel that is redesigned, and the page about all nodes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.designs.bundle import Bundle
from bags.samples import f1tenth
from nlsid_core import files
from nlsid_core.models import DifferenceEquation
from nlsid_core.progress import silent
from nlsid_ros import qos
from tests.ros.processes import ROOT, call, node_here, process, ros_test, service, stop

pytestmark = ros_test

CONFIG = config_file("f1tenth.yaml")


def test_a_model_is_identified_on_request_published_and_can_be_called_off(tmp_path: Path) -> None:
    models: list[str] = []
    said: list[str] = []

    def hear_model(message: String) -> None:
        models.append(message.data)

    def hear_status(message: DiagnosticArray) -> None:
        said.extend(status.message for status in message.status)

    parameters = {"bags": f"['{f1tenth()[0].parent}']", "config": CONFIG, "out": tmp_path / "out"}
    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.model_identifier", **parameters) as identifier,
    ):
        node.create_subscription(String, "/model_identifier/model", hear_model, qos.DOCUMENT)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        identify, cancel = "/model_identifier/identify", "/model_identifier/cancel"
        service(node, spin_until, cancel)  # known before it is needed
        spin_until(lambda: "idle" in said)

        assert call(node, spin_until, identify).success
        assert not call(node, spin_until, identify).success, "one at a time"
        assert call(node, spin_until, cancel).success
        spin_until(lambda: "cancelled" in said)
        assert not models

        call(node, spin_until, identify)
        spin_until(lambda: bool(models))
        spin_until(lambda: any("PROVED" in text for text in said))
        stop(identifier)
    model = DifferenceEquation.from_document(files.parse_document(models[0]))
    assert len(model) == 4


def test_a_redesigned_funnel_is_published_again_and_a_forged_one_is_not(tmp_path: Path) -> None:
    config = load_config(CONFIG)
    identify_bags(f1tenth(), config, tmp_path, progress=silent)
    design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)
    funnels: list[str] = []
    said: list[str] = []
    pictures: list[object] = []

    def hear_design(message: String) -> None:
        funnels.append(Bundle.parse(message.data).digest)

    def hear_status(message: DiagnosticArray) -> None:
        said.extend(status.message for status in message.status)

    with (
        node_here("test_operator") as (node, spin_until),
        process("nlsid_ros.funnel_publisher", funnel=tmp_path / documents.FUNNEL) as publisher,
    ):
        node.create_subscription(String, "/funnel_publisher/design", hear_design, qos.DOCUMENT)
        node.create_subscription(
            MarkerArray, "/funnel_publisher/tube", pictures.append, qos.DOCUMENT
        )
        node.create_subscription(
            JointTrajectory, "/funnel_publisher/nominal", pictures.append, qos.DOCUMENT
        )
        node.create_subscription(DiagnosticArray, "/diagnostics", hear_status, qos.EVENTS)
        spin_until(lambda: len(funnels) == 1 and len({type(each) for each in pictures}) == 2)
        lengths = {
            len(each.markers[-1].points) if isinstance(each, MarkerArray) else len(each.points)  # type: ignore[attr-defined]
            for each in pictures
        }
        assert lengths == {117}

        assert config.funnel is not None
        wider = config.model_copy(
            update={"funnel": config.funnel.model_copy(update={"safety_factor": 2.0})}
        )
        design_funnel_files(tmp_path / documents.MODEL, wider, tmp_path)
        spin_until(lambda: len(funnels) > 1)
        design = files.load_document(tmp_path / documents.FUNNEL)
        spin_until(lambda: funnels[-1] == files.digest(design))

        count = len(funnels)
        forged = design | {"tubes": [design["tubes"][0] | {"level": 2.0}]}
        files.write_document(tmp_path / documents.FUNNEL, forged)
        spin_until(lambda: any("REJECTED" in text for text in said))
        assert len(funnels) == count
        stop(publisher)


def test_the_page_about_the_nodes_is_what_the_nodes_are() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "nlsid_ros.interfaces"],
        capture_output=True,
        text=True,
        env=dict(os.environ),
        cwd=ROOT,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    page = (ROOT / "docs" / "nodes.md").read_text()
    assert page == done.stdout, "run python -m nlsid_ros.interfaces > docs/nodes.md"
