"""The page of a design folder says what the kernel decides now, and runs nothing."""

import hashlib
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bags.chain.config import load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.commands.cli import app
from bags.designs import documents
from bags.pictures.folder_report import Held, folder_page
from bags.samples import f1tenth
from bags.tools.info import bag_info
from nlsid_core import designs, kernel
from nlsid_core.errors import DocumentError
from tests.continuous_stage import composed
from tests.core.kernel.mutations import CORPUS

CONFIG = Path(__file__).resolve().parents[2] / "config" / "f1tenth.yaml"


def nlsid(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    assert done.exit_code in (0, 1), done.output
    return done.output


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
        "lost",
    ):
        assert chapter in page.text
    assert page.tags.count("svg") == 3
    assert "script" not in page.tags
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.links)


def test_bags_with_nothing_lost_share_a_row_and_the_others_have_their_own(design: Path) -> None:
    bags = [bag_info(bag) for bag in f1tenth()[:3]]
    topics = tuple(
        replace(topic, times=replace(topic.times, gaps=int(topic.topic == "/odom")))
        for topic in bags[1].topics
    )
    holed = replace(bags[1], topics=topics)
    page = folder_page(design, Held([bags[0], holed, bags[2]]))
    cell = "<td>([^<]*)</td>"
    rows = re.findall(f"<tr>{cell}<td>(/[^<]*)</td>{cell}{cell}{cell}", page)
    names = [bag.path.name for bag in bags]
    assert rows == [
        (names[1], "/odom", "121", "40 Hz", "1"),
        (f"{names[0]} and 2 more", "/cmd_vel", "120", "40 Hz", "0"),
        (f"{names[0]} and 2 more", "/steering_command", "120", "40 Hz", "0"),
        (f"{names[0]} and 1 more", "/odom", "121", "40 Hz", "0"),
    ]


def test_every_file_has_its_digest_and_the_proofs_that_it_is_a_part_of(design: Path) -> None:
    page = folder_page(design, Held())
    for path in design.glob("*.json"):
        digest = f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
        assert page.count(digest) == 1, path
    model = page[page.index("<td>model.json</td>") :].partition("</tr>")[0]
    assert "model of funnel.proof.json; model of model.proof.json" in model


@pytest.mark.pictures
def test_a_composition_is_drawn_from_its_files(tmp_path: Path) -> None:
    """Two stages of a second, with no picture in their folder."""
    page = folder_page(composed(tmp_path), Held())
    assert "PROVED composition of 2 funnels" in page
    assert page.count("<svg") == 1
    assert "<figcaption>The funnel: the tube around the motion</figcaption>" in page
    assert "stage1.vector_field of composition.proof.json" in page


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
        page = Page(folder_page(design, Held())).text
    finally:
        proof.write_text(content)
    assert "REJECTED" in page
    assert "A proof of this folder does not hold now." in page


@pytest.mark.pictures
def test_a_funnel_of_equations_shows_picture_widths_equations_and_limits(tmp_path: Path) -> None:
    for file in (CORPUS / "continuous_funnel" / "held").iterdir():
        name = designs.PROOF if file.name == "claim.proof.json" else file.name
        shutil.copy(file, tmp_path / name)
    design = documents.load(tmp_path)
    page = Page(folder_page(tmp_path, Held()))
    assert page.tags.count("svg") == 1
    shown = [float(number) for number in re.findall(r"± ([\d.e-]+)", page.text)]
    for knot in (0, -1):
        half = np.linalg.inv(design.funnel.P[knot] / design.funnel.rho[knot])[0, 0] ** 0.5
        assert any(half <= number <= half * 1.002 for number in shown)
    for i, equation in enumerate(design.model.pieces[0]):
        (line,) = re.findall(rf"dx{i}/dt = (.*?)(?:dx|inputs are)", page.text)
        assert len(re.split(" [+-] ", line)) == len(list(equation.terms()))
    assert f"an input is at most {design.claim['hold']:g} s old" in page.text


def test_a_picture_that_is_none_is_left_out(design: Path) -> None:
    picture = design / documents.FUNNEL_PLOT
    picture.write_bytes(b"<script>alert(1)</script>")
    try:
        assert "alert" not in folder_page(design, Held())
    finally:
        picture.unlink()


def test_a_folder_without_a_design_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match=r"no proof and no report\.html"):
        folder_page(tmp_path, Held())
