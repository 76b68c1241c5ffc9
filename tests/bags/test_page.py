"""The page of a design folder and the tables that commands print: every number whole."""

import io
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bags.chain.config import load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.commands import show
from bags.commands.page import folder_page
from bags.designs import documents
from bags.monitoring.replay import Replay
from bags.pictures import tables
from bags.tools.fitness import LEAST_OVERLAP
from nlsid import Dataset, Degrees, Polynomial, Rse, Sem, Status, Trajectory, f1tenth, identify
from nlsid_core import designs, kernel
from nlsid_core.errors import DocumentError
from nlsid_core.running.reading import Reading
from tests.bag_messages import COMMAND, SPEED, speed_bag
from tests.continuous_stage import composed
from tests.core.kernel.mutations import CORPUS
from tests.verbs import nlsid

CONFIG = Path(__file__).resolve().parents[2] / "config" / "f1tenth.yaml"


@pytest.fixture(scope="module")
def design(f1tenth_chain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shutil.copytree(f1tenth_chain, tmp_path_factory.mktemp("report") / "car <1>")


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value or "" for key, value in attrs if key in ("href", "src", "xlink:href")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_it_has_every_chapter_and_needs_nothing_else(design: Path) -> None:
    bag = f1tenth()[4]
    nlsid("report", design, bag, "--config", CONFIG)
    page = Page((design / documents.DESIGN_REPORT).read_text())
    for proof in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
        assert str(kernel.check(design / proof)).split("\n")[0] in page.text
    for chapter in (
        "What is proved",
        "How well it simulates",
        "what it can catch",
        "Recordings held against the funnel",
        bag.name,
        "car <1>",
        "Recordings and their losses",
        "/odom",
        "longest",
    ):
        assert chapter in page.text
    assert page.tags.count("svg") == 3
    assert "script" not in page.tags
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.links)


@pytest.mark.pictures
def test_a_funnel_of_equations_and_a_composition_are_drawn_from_their_files(tmp_path: Path) -> None:
    """Of a composition two stages of a second, with no picture in their folder."""
    for file in (CORPUS / "continuous_funnel" / "held").iterdir():
        name = designs.PROOF if file.name == "claim.proof.json" else file.name
        shutil.copy(file, tmp_path / name)
    (tmp_path / "both").mkdir()
    for folder, proved in ((tmp_path, "funnel"), (composed(tmp_path / "both"), "composition")):
        page = folder_page(folder)
        assert re.search(f"PROVED .*{proved}", page)
        assert page.count("<svg") == 1
        assert "<figcaption>The funnel: the tube around the motion</figcaption>" in page


def test_every_bag_that_did_not_make_the_design_is_judged_and_the_others_are_named(
    design: Path, tmp_path: Path
) -> None:
    """A faulty bag that no split names, and a training trial that goes by another name."""
    bags, settings = f1tenth(), load_config(CONFIG)
    sign = next(bag for bag in bags if bag.name in settings.split.test)
    trained = next(bag for bag in bags if bag.name not in settings.split.test)
    again, faulty = tmp_path / "again", tmp_path / "faulty"
    shutil.copytree(trained, again)
    write_faulty_copy(sign, faulty, settings.signals.response[0].path, FAULTS["scaled by 0.6"])
    said = nlsid("report", design, sign, again, faulty, "--config", CONFIG)
    judged, _, rest = (
        Page((design / documents.DESIGN_REPORT).read_text())
        .text.partition("Recordings held against the funnel")[2]
        .rpartition("Not judged")
    )
    assert all(name in judged for name in (sign.name, "faulty"))
    assert "violated" in judged
    for text in (rest, said.partition("not judged")[2]):
        assert re.match(
            r": again \(used for (training|calibration|training and calibration)\)", text
        )
    by_choice = nlsid("report", design, again)
    assert "judged all the same: again (used for" in by_choice


def test_a_forged_proof_is_rejected_on_the_page(design: Path) -> None:
    proof = design / documents.FUNNEL_PROOF
    content = proof.read_text()
    try:
        proof.write_text(re.sub(r"(sha256:)(.)", lambda m: m[1] + "01"[m[2] == "0"], content))
        page = Page(folder_page(design)).text
    finally:
        proof.write_text(content)
    assert "REJECTED" in page
    assert "A proof of this folder does not hold now." in page


def test_a_picture_that_is_none_is_left_out(design: Path) -> None:
    picture = design / documents.FUNNEL_PLOT
    picture.write_bytes(b"<script>alert(1)</script>")
    try:
        assert "alert" not in folder_page(design)
    finally:
        picture.unlink()


def test_a_folder_without_a_design_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match=r"no proof and no report\.html"):
        folder_page(tmp_path)


# -- What the commands print fits 80 columns, with every number whole


def printed(table: object) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def replay(*readings: Reading) -> Replay:
    return Replay("run_of_a_tank", readings, "temperature", "degC", 1.0, period=0.5)


def test_what_a_monitor_says_of_the_worst_bag_is_not_cut() -> None:
    bad = Reading(
        231.0, Status.ASSUMPTION_VIOLATED, -151.816, 736897.47, worst_axis="temp temperature"
    )
    text = printed(show.replay_table([replay(bad)]))
    words = {word for line in text.splitlines()[3:] for word in line.split()}
    assert {"assumption", "violated", "-151.816", "231.000", "10000", "0.5", "s"} <= words
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_name_that_fits_beside_the_numbers_stays_whole() -> None:
    inside = Reading(9.85, Status.INSIDE, 0.861, 0.12, worst_axis="height")
    bad = Reading(34.8, Status.ASSUMPTION_VIOLATED, -2.588, 200.0, worst_axis="position")
    named = [replace(replay(r), name=n) for r, n in ((inside, "duffing_test_0"), (bad, "x" * 30))]
    text = printed(show.replay_table(named))
    assert "duffing_test_0" in text.split()
    assert text.count("x") - text.count("axis") == 30
    assert max(map(len, text.splitlines())) <= 80
    assert "axis" not in printed(show.replay_table(named[1:])), "it is the same in every row"


@pytest.mark.parametrize("last", [0.01, float("nan")])
def test_what_is_used_is_the_most_that_a_sample_used(last: float) -> None:
    fading = (
        Reading(0.0, Status.INSIDE, 0.5, 0.4),
        Reading(0.5, Status.ASSUMPTION_VIOLATED, 0.5, 1.25),
        Reading(1.0, Status.INSIDE, 0.5, last),
    )
    assert replay(*fading).assumption == 1.25
    assert np.isnan(replay(Reading(0.0, Status.INSIDE, 0.5)).assumption)
    assert np.isnan(replay().assumption)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (Polynomial(1, (1,), Degrees(left=3), set="3.8"), Sem(certified=True)),
        (Polynomial(2), Rse()),
    ],
)
def test_the_rate_of_a_method_with_a_long_name_is_not_cut(kind: Any, method: Any) -> None:
    rng, trials = np.random.default_rng(1), []
    for name in ("a", "b"):
        u = np.repeat(rng.uniform(-1, 1, 20), 10)[:, None]
        y = np.zeros((200, 1))
        for k in range(199):
            y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
        trials.append(Trajectory(t=0.1 * np.arange(200), y=y, u=u, name=name))
    data = Dataset(tuple(trials))
    fit = identify(data, kind, method=method, test=data)
    text = printed(tables.methods_table(fit, data))
    assert "…" not in text
    assert all(len(line) == 80 for line in text.splitlines() if line.startswith("│"))
    proved = [c.proof for c in fit.candidates if c.proof is not None]
    assert len(proved) == len(fit.candidates) > 1
    for candidate in fit.candidates:
        assert tables.stability(candidate).removeprefix("[green]") in text


def test_a_recording_too_short_for_a_delay_is_said_to_be_short(tmp_path: Path) -> None:
    bag = tmp_path / "short"
    few = np.arange(LEAST_OVERLAP // 2, dtype=float)
    speed_bag(bag, few, few)
    said = nlsid("bag", "check", bag, "-u", COMMAND, "-y", SPEED, status=(0, 1))
    assert "do not overlap" not in said
    assert f"less than {LEAST_OVERLAP} steps of the response" in " ".join(said.split())
