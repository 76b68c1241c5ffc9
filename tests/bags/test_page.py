"""The page of a design folder says what the kernel decides now, and runs nothing."""

import hashlib
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from bags.chain.config import load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.commands.page import folder_page
from bags.designs import documents
from bags.samples import f1tenth
from nlsid_core import designs, kernel
from nlsid_core.errors import DocumentError
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


def test_every_file_has_its_digest_and_the_proofs_that_it_is_a_part_of(design: Path) -> None:
    page = folder_page(design)
    for path in design.glob("*.json"):
        digest = f"sha256:{hashlib.sha256(path.read_bytes()).hexdigest()}"
        assert page.count(digest) == 1, path
    model = page[page.index("<td>model.json</td>") :].partition("</tr>")[0]
    assert "model of funnel.proof.json; model of model.proof.json" in model


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
