"""A composition in the place of a funnel: published, decided, driven, drawn and replayed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bags.designs.bundle import Bundle, decide
from bags.designs.design import Wiring
from bags.designs.documents import load_proved
from bags.viewing.drawn import HalfWidths
from nlsid_core import designs
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.running.comparison import Centre
from nlsid_core.running.controller import Limits
from nlsid_core.running.reading import Reading, Status
from tests.continuous_stage import composed

WIRING = Wiring.parse(["/joints:position[0]"], ["/effort:effort[0]"], 0.05)


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
        load_proved(path.with_name(designs.COMPOSITION))
    path.unlink()
    with pytest.raises(CertificateRejected, match=r"stage2.*funnel"):
        load_proved(path.with_name(designs.COMPOSITION))


def test_it_is_driven_from_stage_to_stage_and_held_against_each(folder: Path) -> None:
    design = load_proved(folder / designs.COMPOSITION, wiring=WIRING).design
    controller = design.controller(Limits(lowest=-9.0, highest=9.0, stop_rate=9.0), 1.0)
    monitor, x = design.monitor(Centre.PROFILE), np.array([0.05])
    stages, readings = [], []
    for k in range(40):
        u = controller.update(0.05 * k, x)
        stages.append(controller.stage)
        readings.append(monitor.update(0.05 * k, x, u))
        x = x + 0.05 * u
    assert not controller.ended
    assert stages == [1] * 20 + [2] * 20
    assert {reading.status for reading in readings} == {Status.INSIDE}
    assert [int(reading.assuming[6]) for reading in readings] == stages
    widths = HalfWidths(design)
    for k in (0, 19, 20, 40):
        stage = design.stages[int(k >= 20)].funnel
        said = widths.of(Reading(0.05 * k, Status.INSIDE))
        assert said["half_width"] == pytest.approx(stage.widths(0.05 * k)[0])
