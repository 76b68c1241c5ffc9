"""Identification in the background: it gets there, says why not, and can be called off."""

import time
from pathlib import Path

from bags.chain.background import BackgroundIdentification, Progress
from bags.chain.shipped import config_file
from bags.monitoring.documents import MODEL, MODEL_PROOF
from bags.samples import f1tenth
from nlsid_core.certificate import check

CONFIG = config_file("f1tenth.yaml")
PATIENCE = 60.0  # s


def wait(work: BackgroundIdentification) -> Progress:
    deadline = time.monotonic() + PATIENCE
    while not (progress := work.poll()).done:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return progress


def test_it_writes_a_model_and_its_proof(tmp_path: Path) -> None:
    work = BackgroundIdentification(f1tenth(), CONFIG, tmp_path)
    assert wait(work) == Progress("done", 1.0, done=True)
    assert "PROVED" in str(check(tmp_path / MODEL_PROOF))
    assert (tmp_path / MODEL).is_file()


def test_what_is_wrong_with_the_bags_is_said(tmp_path: Path) -> None:
    progress = wait(BackgroundIdentification([tmp_path / "nowhere"], CONFIG, tmp_path / "out"))
    assert progress.done
    assert "nowhere" in progress.error


def test_called_off_it_ends_at_once_and_leaves_nothing(tmp_path: Path) -> None:
    work = BackgroundIdentification(f1tenth(), CONFIG, tmp_path / "out")
    started = time.monotonic()
    work.cancel()
    assert time.monotonic() - started < 5.0
    assert work.poll().what == "cancelled"
    assert not (tmp_path / "out").exists()
