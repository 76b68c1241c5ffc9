"""A composition in the place of a funnel: published, decided, driven, drawn and replayed."""

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.designs.bundle import Bundle
from bags.designs.documents import load
from bags.designs.wiring import wiring_of
from bags.monitoring.replay import replay_messages
from bags.viewing.drawn import HalfWidths
from bags.viewing.replay import Recording
from bags.viewing.scene import Scene
from nlsid_core import designs
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Reading, Status
from tests.bags.deciding import decide
from tests.continuous_stage import composed, write_run
from tests.verbs import nlsid

RESPONSE, COMMAND = "/joints:position[0]", "/effort:effort[0]"
WIRING = wiring_of([RESPONSE], [COMMAND], 0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two stages of a second each."""
    return composed(tmp_path_factory.mktemp("composed"))


def test_a_composition_is_published_and_decided_as_a_whole(folder: Path) -> None:
    bundle = Bundle.load(folder / designs.COMPOSITION)
    assert len(bundle.contents) == 9
    answer = decide(bundle.text())
    assert "composition of 2 funnels from 0 to 2 s" in answer["proved"]
    assert answer["digest"] == bundle.digest == bundle.design().digest
    document = json.loads(bundle.text())
    del document["files"]["stage2.policy"]
    assert "stage2.policy" in decide(json.dumps(document))["refused"]
    document = json.loads(bundle.text())
    document["files"]["funnel"] = document["files"]["stage1.funnel"]
    assert "the proof is about" in decide(json.dumps(document))["refused"]


def test_a_stage_that_was_changed_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path / "copy")
    path = tmp_path / "copy" / "stage2.funnel.json"
    path.write_text(path.read_text().replace("stage", "stage ") + " ")
    with pytest.raises(CertificateMismatch, match=r"stage2"):
        load(path.with_name(designs.COMPOSITION))
    path.unlink()
    with pytest.raises(CertificateRejected, match=r"stage2.*funnel"):
        load(path.with_name(designs.COMPOSITION))


def test_a_run_from_stage_to_stage_is_held_against_each(folder: Path, tmp_path: Path) -> None:
    design = load(folder / designs.COMPOSITION, wiring=WIRING)
    monitor, x = design.monitor(Centre.PROFILE), np.array([0.05])
    stages, readings, samples = [], [], []
    for k in range(40):
        stages.append(1 + int(k >= 20))
        u = design.stages[stages[-1] - 1].policy(k * 50_000_000 / 1e9, x)
        readings.append(monitor.update(k * 50_000_000 / 1e9, x, u))
        samples.append((x, np.atleast_1d(u)))
        x = x + 0.05 * u
    assert {reading.status for reading in readings} == {Status.INSIDE}
    assert [int(reading.assuming[6]) for reading in readings] == stages
    write_run(tmp_path / "bag", design, samples)
    replayed = [
        r for _, r, _ in replay_messages(design, tmp_path / "bag") if r.status.value != "unknown"
    ]
    assert [r.margin for r in replayed] == [r.margin for r in readings]
    where = ["-y", RESPONSE, "-u", COMMAND, "--period", "0.05"]
    assert "inside" in nlsid("monitor", folder, tmp_path / "bag", *where)
    scene = Scene("a recording", "replay")
    recording = Recording(
        load(folder / designs.COMPOSITION, wiring=WIRING),
        tmp_path / "bag",
        centre=Centre.PROFILE,
    )
    recording.play(scene, 1e6, threading.Event())
    assert "verdict: inside." in str(scene.verdict())
    widths = HalfWidths(design)
    for k in (0, 19, 20, 40):
        stage: Any = design.stages[int(k >= 20)].funnel
        shown = widths.of(Reading(0.05 * k, Status.INSIDE))
        assert shown["half_width"] == pytest.approx(stage.widths(0.05 * k)[0])
