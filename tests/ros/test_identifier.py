"""`model_identifier` over DDS: the last recordings, called off, and never in anyone's way."""

import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS (extra `ros`)")

from std_msgs.msg import String

from bags.chain.shipped import config_file
from bags.designs import documents
from nlsid import check, f1tenth
from nlsid_core import files
from nlsid_core.models import DifferenceEquation
from nlsid_ros import qos
from tests.bag_messages import START_NS, speed_bag
from tests.ros.processes import Bench, ros_test, stop

pytestmark = ros_test

NAME = "model_identifier"


def test_the_last_recording_is_identified_while_the_node_answers(
    bench: Bench, tmp_path: Path
) -> None:
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
    models: list[String] = []
    settings = {"bags": f"['{trials}']", "last": 1, "config": config, "out": tmp_path / "out"}
    identifier = bench.start(NAME, **settings)
    bench.listen(String, f"/{NAME}/model", models.append, qos.DOCUMENT)
    bench.hears("idle", NAME)
    assert bench.call(f"/{NAME}/identify").success
    assert not bench.call(f"/{NAME}/identify").success, "one at a time"
    assert bench.call(f"/{NAME}/cancel").success
    bench.hears("cancelled", NAME)
    assert not models
    bench.said.clear()
    assert bench.call(f"/{NAME}/identify").success
    busy = 0
    while not models and not bench.call(f"/{NAME}/identify").success:
        busy += 1
    bench.spin_until(lambda: bool(models))
    bench.hears("PROVED", NAME)
    stop(identifier)
    assert busy > 5, "it answers while a worker works"
    assert len({values["seconds"] for _, values in bench.said[NAME]}) > 1, "how long it lasts"
    model = DifferenceEquation.from_document(files.parse_document(models[0].data))
    assert "PROVED" in str(check(tmp_path / "out" / documents.MODEL_PROOF))
    assert [name for name, _ in model.bags] == ["run_1"], "the newest, whatever its name"
    assert model.training == documents.load_model(tmp_path / "out" / documents.MODEL).training


def test_a_folder_without_recordings_is_named(bench: Bench, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    out, config = tmp_path / "out", config_file("f1tenth.yaml")
    bench.start(NAME, bags=f"['{tmp_path / 'empty'}']", last=1, config=config, out=out)
    bench.hears("idle", NAME)
    answer = bench.call(f"/{NAME}/identify")
    assert not answer.success
    assert "empty is not a bag and holds none" in answer.message
    assert not out.exists()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ended_by_a_signal_it_takes_its_worker_with_it(
    bench: Bench, tmp_path: Path, how: signal.Signals
) -> None:
    out, config = tmp_path / "out", config_file("f1tenth.yaml")
    identifier = bench.start(NAME, bags=f"['{f1tenth()[0].parent}']", config=config, out=out)
    assert bench.call(f"/{NAME}/identify").success
    children = Path(f"/proc/{identifier.pid}/task/{identifier.pid}/children").read_text().split()
    assert children
    stop(identifier, how)
    bench.spin_until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    assert not out.exists()
