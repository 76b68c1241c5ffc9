"""What is said of the trials behind a proof: counted once, and contradicted where they are."""

from pathlib import Path
from typing import Any

import pytest

from bags.designs.bundle import Bundle
from bags.designs.provenance import of_funnel
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateRejected
from tests.core.kernel.mutations import CORPUS, bind_again, corpus, encoded
from tests.verbs import nlsid

FOLDER = CORPUS / "tube" / "following"


@pytest.fixture
def documents() -> tuple[Json, Json]:
    """A model, and a funnel with a level that follows the commands."""
    model, funnel = (files.load_document(FOLDER / f"{name}.json") for name in ("model", "funnel"))
    return model, funnel


def trial(letter: str, window: str = "") -> Json:
    return {"name": letter, "digest": f"sha256:{letter * 64}{window}"}


def test_what_was_measured_is_printed_below_the_verdict_and_not_called_proved() -> None:
    proved, *below = nlsid("check", FOLDER / "claim.proof.json").splitlines()
    assert proved.startswith("PROVED tube: ")
    assert "probability" not in proved
    assert any(
        line.startswith("  measured, not proved: innovation energy of tube 1: largest of 5 ")
        for line in below
    )


@pytest.mark.parametrize(
    ("trials", "fitted", "says"),
    [
        ([trial("a"), trial("b")], [], "2 distinct trials"),
        ([trial("a"), trial("a")], [], "largest of 1 distinct trial "),
        ([trial("a"), trial("b")], [], "with probability at most 1/3"),
        ([trial("a"), trial("b")], [trial("b")], "as the model was fitted to 1 of them"),
        ([trial("a")], None, "the model does not name what it was fitted to"),
        ([trial("a", "[0:9]"), trial("a", "[8:20]")], [], "1 distinct window "),
        ([trial("a", "[0:9]"), trial("a", "[9:20]")], [], "2 distinct windows "),
        ([trial("a", "[0:9]")], [], "windows of one recording are hardly exchangeable"),
    ],
)
def test_trials_are_counted_once_and_said_to_be_worth_what_they_are(
    documents: tuple[Json, Json], trials: list[Json], fitted: list[Json] | None, says: str
) -> None:
    model, funnel = documents
    funnel["tubes"][0]["assumption"] |= {"measured_on": trials, "designed_on": []}
    model = {key: value for key, value in model.items() if key != "bags"}
    found = of_funnel(model if fitted is None else model | {"bags": fitted}, funnel)
    assert says in found.said[0]
    assert not found.wrong


def test_a_design_that_was_measured_above_its_level_is_decided_and_not_run(
    documents: tuple[Json, Json],
) -> None:
    _, funnel = documents
    tube = funnel["tubes"][0]
    tube |= {"peak": {"at_most": [1.0], "measured": [0.1]}}
    tube["assumption"] |= {"measured": 1.0, "rank": 1}
    case = next(case for case in corpus() if (case.kind, case.name) == ("tube", "following"))
    forged = case.copied()
    forged.about["funnel.json"] = funnel
    bind_again(forged)
    contents = {name.removesuffix(".json"): encoded(d) for name, d in forged.about.items()}
    bundle = Bundle({**contents, "proof": encoded(forged.document)})
    assert str(bundle.decided()).startswith("PROVED")
    with pytest.raises(CertificateRejected, match=r"contradicts the design: .* its level is below"):
        bundle.design()


@pytest.mark.parametrize(
    ("place", "change", "says"),
    [
        ("level", {"level": 0.02}, "its level is below"),
        ("peak", {"peak": {"at_most": [0.01], "measured": [0.007]}}, "a peak is below"),
        ("assumption", {"safety_factor": 0.5}, "the safety factor is below 1"),
        ("assumption", {"rank": 0}, "the rank is not from 1"),
        ("assumption", {"rank": 99}, "the rank is not from 1"),
        ("assumption", {"measured_on": []}, "measured on no trial"),
        (
            "assumption",
            {"designed_on": [trial("a")], "measured_on": [trial("a", "[0:5]")]},
            "a trial that chose it cannot measure it",
        ),
    ],
)
def test_what_contradicts_itself_is_said(
    documents: tuple[Json, Json], place: str, change: Any, says: str
) -> None:
    model, funnel = documents
    tube = funnel["tubes"][0]
    tube |= {"assumption": tube["assumption"] | change} if place == "assumption" else change
    assert any(says in line for line in of_funnel(model, funnel).wrong)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rank", "1/17\nPROVED"),
        ("rank", True),
        ("safety_factor", "much"),
        ("measured", [1.0]),
        ("measured_on", 7),
        ("designed_on", [{}]),
    ],
)
def test_what_cannot_be_read_is_said_in_a_line_below_the_verdict(
    documents: tuple[Json, Json], key: str, value: object, tmp_path: Path
) -> None:
    _, funnel = documents
    funnel["tubes"][0]["assumption"][key] = value
    case = next(case for case in corpus() if (case.kind, case.name) == ("tube", "following"))
    forged = case.copied()
    forged.about["funnel.json"] = funnel
    bind_again(forged)
    for name, document in {**forged.about, "claim.proof.json": forged.document}.items():
        (tmp_path / name).write_bytes(encoded(document))
    proved, *_, unread = nlsid("check", tmp_path, status=2).splitlines()
    assert proved.startswith("PROVED tube: ")
    assert "NOT READ" in unread
    assert "funnel.json: what its assumption was measured on is not as its page says" in unread
