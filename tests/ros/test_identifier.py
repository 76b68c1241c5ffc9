"""`model_identifier` over DDS: the last recordings, called off, and never in anyone's way."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String

from bags.chain.shipped import config_file
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core import files
from nlsid_core.models import DifferenceEquation
from nlsid_core.proofs import check
from nlsid_ros import qos
from tests.bag_messages import START_NS, speed_bag
from tests.ros.processes import call, node_here, process, ros_test, stop

pytestmark = ros_test

IDENTIFIER = "nlsid_ros.model_identifier"
AT_ONCE = 0.5  # s: a service's answer on a busy machine, while a worker takes seconds


def test_the_last_recording_is_identified_while_the_node_answers_at_once(tmp_path: Path) -> None:
    """Its first three quarters are fitted, its last one scores: a configuration does not know the
    name of a fresh recording.
    """
    trials = tmp_path / "trials"
    rng = np.random.default_rng(3)
    for k, gain in enumerate((0.5, 0.5, 1.0)):
        commands = np.repeat(rng.uniform(0.0, 0.4, 50), 8)
        speeds = np.zeros(len(commands))
        for t in range(1, len(speeds)):
            speeds[t] = 0.9 * speeds[t - 1] + 0.1 * gain * commands[t - 1]
        speeds += 0.002 * rng.standard_normal(len(speeds))
        speed_bag(trials / f"run_{3 - k}", speeds, commands, start_ns=START_NS + k * 10**12)
    content = yaml.safe_load(config_file("f1tenth.yaml").read_text())
    content["split"] = {"share": 0.25}
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(content))
    models: list[str] = []
    said: list[tuple[float, str, float]] = []

    def hear_model(message: String) -> None:
        models.append(message.data)

    def hear(message: DiagnosticArray) -> None:
        for each in message.status:
            progress = {pair.key: pair.value for pair in each.values}["progress"]
            said.append((time.monotonic(), each.message, float(progress)))

    settings = {"bags": f"['{trials}']", "last": 1, "config": config, "out": tmp_path / "out"}
    with (
        node_here("test_operator") as (node, spin_until),
        process(IDENTIFIER, **settings) as identifier,
    ):
        node.create_subscription(String, "/model_identifier/model", hear_model, qos.DOCUMENT)
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        spin_until(lambda: bool(said))
        assert call(node, spin_until, "/model_identifier/identify").success
        slowest, busy = 0.0, 0
        while not models:
            asked = time.monotonic()
            again = call(node, spin_until, "/model_identifier/identify")
            slowest = max(slowest, time.monotonic() - asked)
            busy += not again.success
            if again.success:
                break
        spin_until(lambda: bool(models))
        stop(identifier)
    assert busy > 5
    assert slowest < AT_ONCE
    fractions = [fraction for _, _, fraction in said]
    assert len(set(fractions)) > 3, "progress is told"
    model = DifferenceEquation.from_document(files.parse_document(models[0]))
    assert "PROVED" in str(check(tmp_path / "out" / documents.MODEL_PROOF))
    assert [name for name, _ in model.bags] == ["run_1"], "the newest, whatever its name"
    assert model.training == documents.load_model(tmp_path / "out" / documents.MODEL).training


def test_a_folder_without_recordings_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    said: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        said.extend(each.message for each in message.status)

    settings = {
        "bags": f"['{tmp_path / 'empty'}']",
        "last": 1,
        "config": config_file("f1tenth.yaml"),
        "out": tmp_path / "out",
    }
    with (
        node_here("test_operator") as (node, spin_until),
        process(IDENTIFIER, **settings) as identifier,
    ):
        node.create_subscription(DiagnosticArray, "/diagnostics", hear, qos.EVENTS)
        call(node, spin_until, "/model_identifier/identify")
        spin_until(lambda: any("empty is not a bag and holds none" in text for text in said))
        stop(identifier)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ended_by_a_signal_it_takes_its_worker_with_it(tmp_path: Path, how: signal.Signals) -> None:
    settings = {
        "bags": f"['{f1tenth()[0].parent}']",
        "config": config_file("f1tenth.yaml"),
        "out": tmp_path / "out",
    }
    with (
        node_here("test_operator") as (node, spin_until),
        process(IDENTIFIER, **settings) as identifier,
    ):
        call(node, spin_until, "/model_identifier/identify")
        children = Path(f"/proc/{identifier.pid}/task/{identifier.pid}/children").read_text()
        assert children.split()
        stop(identifier, how)
        spin_until(lambda: not any(Path(f"/proc/{child}").exists() for child in children.split()))
    assert not (tmp_path / "out").exists()
