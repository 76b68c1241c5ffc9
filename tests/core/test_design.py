"""One verb and one Design: what problems refuse, and that a saved design is the one loaded."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from nlsid import (
    ContinuousTracking,
    Dataset,
    Design,
    Fit,
    OutputTube,
    SampledTracking,
    check,
    design,
    integrate_nominal,
    load,
)
from nlsid_core import documents, files
from nlsid_core.design import OutputTubeDesign
from nlsid_core.designs import COMPOSITION, FUNNEL, MODEL, POLICY, PROOF, AnyDesign
from nlsid_core.errors import (
    CertificateMismatch,
    CertificateRejected,
    DataError,
    DocumentError,
    OptionError,
)
from nlsid_core.models import DifferenceEquation
from tests.tracked import assumption, designed, tracked
from tests.verbs import nlsid

PROFILE = ((0.0, 0.0), (7.0, 0.5))


def test_the_verb_solves_what_each_problem_says(tube: OutputTubeDesign, train: Dataset) -> None:
    found = design(OutputTube(tube.model, train, profile=PROFILE, horizon=6.0))
    assert found.funnel.tubes[1].samples == round(6.0 / tube.model.period)
    assert "for at most its 60 samples" in found.verdict.statement
    longer = design(OutputTube(tube.model, train, profile=PROFILE))
    assert len(longer.funnel.tubes) == 1
    assert "for at most its 70 samples" in longer.verdict.statement
    base = tracked()
    problem = SampledTracking(base.model, base.policy, base.feedback, assumption())
    seen: list[str] = []
    sampled = design(problem, progress=lambda what, _: seen.append(what))
    assert sampled.documents() == designed().documents()
    assert set(seen) == {"inlet", "tube"}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"horizon": 7.9}, "horizon 7.9 s is 79 samples; the energy can be measured"),
        ({"inlet": 0.1, "profile": None}, "inlet is 0.1; it should be 0 without a profile"),
        ({"horizon": 0.0}, "horizon is 0.0; it should be a finite number above 0"),
        ({"safety_factor": 0.99}, "safety_factor is 0.99; it should be a finite number, at least"),
        ({"reaction_time": 0.0}, "reaction_time is 0.0; it should be "),
        ({"false_alarms": 0.0}, "false_alarms is 0.0; it should be "),
        ({"inlet": -1e-9}, "inlet is -1e-09; it should be a finite number, at least 0"),
        ({"profile": [(0.0, 0.0)]}, "profile is .* it should be two or more corners"),
        ({"profile": [(1.0, 0.0), (0.0, 1.0)]}, "times should increase"),
        ({"lqr_weights": (0.0, 1.0)}, "lqr_weights is .* two numbers above 0, or None"),
    ],
)
def test_a_tube_that_makes_no_sense_is_refused(
    tube: OutputTubeDesign, train: Dataset, options: dict[str, Any], reason: str
) -> None:
    sensible: dict[str, Any] = {"profile": PROFILE, "horizon": 7.0}
    with pytest.raises(DataError, match=reason):
        design(OutputTube(tube.model, train, **(sensible | options)))


@pytest.mark.parametrize("options", [{"goal": 0.0}, {"goal": float("nan")}])
def test_a_sampled_problem_refuses_radii_that_are_not_positive(options: dict[str, float]) -> None:
    base = tracked()
    (key,) = options
    with pytest.raises(OptionError, match=f"{key} is .*; it should be a finite number above 0"):
        SampledTracking(base.model, base.policy, base.feedback, assumption(), **options)


@pytest.fixture(params=["linear", "sampled"])
def any_design(request: pytest.FixtureRequest, tube: OutputTubeDesign) -> AnyDesign:
    return tube if request.param == "linear" else designed()


def test_a_design_is_loaded_as_it_was_saved(any_design: AnyDesign, tmp_path: Path) -> None:
    paths = any_design.save(tmp_path / "made" / "here")
    assert [path.name for path in paths] == [MODEL, POLICY, FUNNEL, PROOF]
    assert check(paths[-1]) == any_design.verdict
    loaded = load(paths[0].parent)
    assert loaded.documents() == any_design.documents()
    assert loaded.verdict == any_design.verdict
    assert type(loaded.funnel) is type(any_design.funnel)
    assert loaded.found is None
    again = loaded.save(tmp_path / "again")
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in again]


def test_a_design_is_not_saved_over_a_file(any_design: AnyDesign, tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("mine")
    for folder in (tmp_path / "notes", tmp_path / "notes" / "inside"):
        with pytest.raises(DataError, match="is a file, not a folder"):
            any_design.save(folder)
    assert (tmp_path / "notes").read_text() == "mine"


@pytest.mark.parametrize("name", [MODEL, POLICY, FUNNEL])
def test_a_file_of_another_design_is_not_loaded(
    any_design: AnyDesign, tmp_path: Path, name: str
) -> None:
    any_design.save(tmp_path)
    document = files.load_document(tmp_path / name)
    (tmp_path / name).write_text(json.dumps(document))  # the same content, other bytes
    with pytest.raises(CertificateMismatch):
        load(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises((CertificateRejected, DocumentError)):
        load(tmp_path)


def test_a_folder_without_a_proof_is_an_error_of_the_files(
    any_design: AnyDesign, tmp_path: Path
) -> None:
    any_design.save(tmp_path)
    (tmp_path / PROOF).unlink()
    with pytest.raises(FileNotFoundError):
        load(tmp_path)


def test_a_claim_about_several_funnels_is_no_design(any_design: AnyDesign, tmp_path: Path) -> None:
    any_design.save(tmp_path)
    (tmp_path / PROOF).rename(tmp_path / COMPOSITION)
    with pytest.raises(DocumentError):
        load(tmp_path)
    with pytest.raises(DocumentError, match=f"{COMPOSITION} is a proof: give one of the files"):
        documents.load(tmp_path / COMPOSITION)


def test_a_proof_of_something_else_is_no_design(
    tube: OutputTubeDesign, fit: Fit[DifferenceEquation], tmp_path: Path
) -> None:
    tube.save(tmp_path)
    files.write_document(tmp_path / PROOF, fit.proof.document(fit.model, MODEL))
    with pytest.raises(CertificateMismatch, match="is not about it: give the design's folder"):
        load(tmp_path)
    assert "is a file: give the design" in nlsid(
        "monitor", tmp_path / FUNNEL, tmp_path, status=None
    )


def test_nothing_is_a_design_that_the_kernel_does_not_prove(tube: OutputTubeDesign) -> None:
    first, *rest = tube.funnel.tubes
    narrower = replace(first, half_widths=first.half_widths * 0.9)
    narrow = replace(tube.funnel, tubes=(narrower, *rest))
    with pytest.raises(CertificateRejected):
        Design.proved(
            tube.model, tube.policy, narrow, claim=tube.claim, proof=tube.proof, found=None
        )
    assert tube.decided() == tube.verdict
    with pytest.raises(CertificateRejected):
        replace(tube, certificate=tube.certificate | {"proof": {"multipliers": []}}).decided()
    same = Design.proved(
        tube.model, tube.policy, tube.funnel, claim=tube.claim, proof=tube.proof, found=None
    )
    assert same.verdict == tube.verdict


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"shape": "Q"}, "shape is 'Q'; it should be one of rho, P"),
    ],
)
def test_a_continuous_problem_names_what_it_knows(options: dict[str, Any], reason: str) -> None:
    at_rest = integrate_nominal(lambda x: -x, lambda _: [], t=[0.0, 1.0], start=[0.0])
    with pytest.raises(OptionError, match=reason):
        ContinuousTracking(lambda x: -x, at_rest, goal=[1.0], **options)
