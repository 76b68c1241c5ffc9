"""Funnels that follow each other: one claim over their files, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid import ContinuousTracking, Goal, Nominal, VectorField, check, integrate_nominal
from nlsid_core import files as documents
from nlsid_core.design import compose_funnels, design_funnel
from nlsid_core.errors import CertificateMismatch, DataError, Infeasible
from tests.core.kernel import refusals
from tests.decided import decided
from tests.funnel_files import forged_by
from tests.marks import slow_among
from tests.verbs import nlsid

Files = dict[str, Any]


def motion(start: float, end: float, *, damping: float = 0.2) -> tuple[VectorField, Nominal]:
    """A hanging pendulum to third order, at rest."""

    def pendulum(x: Any, u: Any) -> Any:
        return np.array([x[1], -x[0] + x[0] ** 3 / 6 - damping * x[1] + u[0]])

    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(start, end, 9)
    return field, integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))


@pytest.fixture(scope="module")
def proofs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three stages designed from the last to the first, with heavier air in the last."""
    goal: Any = 20 * np.eye(2)
    paths = []
    for start, damping in ((2.0, 0.4), (1.0, 0.2), (0.0, 0.2)):
        design = design_funnel(
            ContinuousTracking(*motion(start, start + 1, damping=damping), goal=goal)
        )
        paths.append(design.save(tmp_path_factory.mktemp("stage"))[-1])
        goal = Goal.start_of(design.funnel)
    return paths[::-1]


@pytest.fixture(scope="module")
def files(proofs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Files:
    """The composition's thirteen documents."""
    folder = tmp_path_factory.mktemp("whole")
    compose_funnels(proofs, folder)
    return {path.name: json.loads(path.read_text()) for path in folder.iterdir()}


def test_three_stages_are_one_funnel_and_each_is_still_its_own(
    proofs: list[Path], tmp_path: Path
) -> None:
    path = compose_funnels(proofs, tmp_path)
    verdict = check(path)
    assert verdict.margin == min(check(tmp_path / f"stage{i}.proof.json").margin for i in (1, 2, 3))
    stages = [check(tmp_path / f"stage{i}.proof.json") for i in (1, 2, 3)]
    assert verdict.statement == (
        "composition of 3 funnels from 0 to 3 s, changing at 1, 2 s: every solution that is in one "
        "of them at a time of its own stays in it and in those that follow; the last is a "
        + stages[2].statement
    )
    assert verdict.assumptions == tuple(
        f"stage{i}: {text}" for i, stage in enumerate(stages, start=1) for text in stage.assumptions
    )
    assert verdict.digests["stage2.policy"] == stages[1].digests["policy"]


def test_the_command_line_composes_and_checks(proofs: list[Path], tmp_path: Path) -> None:
    stages = [option for proof in proofs[:2] for option in ("--compose", str(proof))]
    assert "8 files" in nlsid("funnel", tmp_path, *stages)
    checked = nlsid("check", tmp_path / "composition.proof.json")
    assert "PROVED composition of 2 funnels" in checked


def test_stages_are_not_replaced_by_others(proofs: list[Path], tmp_path: Path) -> None:
    compose_funnels(proofs, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    later = [tmp_path / f"stage{k}.proof.json" for k in (2, 3)]
    with pytest.raises(DataError, match="would be replaced"):
        compose_funnels(later, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_stages_in_the_wrong_order_are_not_composed(proofs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not follow"):
        compose_funnels(proofs[::-1], tmp_path)
    with pytest.raises(DataError, match="two or more"):
        compose_funnels(proofs[:1], tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_stage_that_ends_wider_than_the_next_starts_is_told_by_how_much(
    proofs: list[Path], tmp_path: Path
) -> None:
    after = documents.load_document(proofs[1].with_name("funnel.json"))
    goal = np.array(after["P"][0]) / after["rho"][0] / 1.3
    wide = design_funnel(ContinuousTracking(*motion(0.0, 1.0), goal=goal)).save(tmp_path / "wide")[
        -1
    ]
    with pytest.raises(Infeasible, match=r"reaches 1\.28"):  # 1.3 less the room the LQR leaves
        compose_funnels([wide, proofs[1]], tmp_path / "out")


def swapped_order(files: Files) -> None:
    """Stages 1 and 2, proofs and all."""
    about = files["composition.proof.json"]["claim"]["about"]
    about["stage1"], about["stage2"] = about["stage2"], about["stage1"]


def start_shrunk(files: Files) -> None:
    """Stage 2 starts 1 % narrower: stage 1 no longer ends inside it."""
    files["stage2.funnel.json"]["rho"][0] *= 0.99


def other_funnel(files: Files) -> None:
    """Stage 2 has the third stage's funnel, whose proof is another."""
    files["stage2.funnel.json"] = files["stage3.funnel.json"]


def stage_missing(files: Files) -> None:
    """A multiplier less: the claim is then about too many files."""
    files["composition.proof.json"]["proof"]["multipliers"].pop()


def stage_left_out(files: Files) -> None:
    """From 1 to 2 s there is no funnel."""
    whole = files["composition.proof.json"]
    whole["claim"]["about"]["stage2"] = whole["claim"]["about"].pop("stage3")
    whole["proof"]["multipliers"].pop()


def multiplier_raised(files: Files) -> None:
    """Past 1 the S-lemma gives nothing."""
    files["composition.proof.json"]["proof"]["multipliers"][0] = 1.01


def proof_exchanged(files: Files) -> None:
    """Stage 2's proof is a copy of stage 1's."""
    files["stage2.proof.json"] = files["stage1.proof.json"]


def stages_without_end(files: Files) -> None:
    """A hundred thousand multipliers for three stages."""
    files["composition.proof.json"]["proof"]["multipliers"] = [0.5] * 100_000


FORGERIES: list[tuple[Callable[[Files], None], str]] = [
    (swapped_order, "not_covered"),
    (start_shrunk, "not_definite"),
    (other_funnel, "mismatch"),
    (stage_missing, "malformed"),
    (stage_left_out, "not_covered"),
    (multiplier_raised, "not_definite"),
    (proof_exchanged, "not_covered"),
    (stages_without_end, "too_large"),
]


def rebound(files: Files, folder: Path) -> Path:
    """Every digest made to fit again, as a forger would."""
    for i in (1, 2, 3):
        about = files[f"stage{i}.proof.json"]["claim"]["about"]
        for binding in about.values():
            binding["digest"] = documents.digest(files[binding["file"]])
    for binding in files["composition.proof.json"]["claim"]["about"].values():
        binding["digest"] = documents.digest(files[binding["file"]])
    for name, document in files.items():
        (folder / name).write_bytes(documents.encode(document))
    return folder / "composition.proof.json"


@pytest.mark.parametrize(
    ("forge", "reason"),
    slow_among(FORGERIES, {"stages_without_end"}),
    ids=lambda f: getattr(f, "__name__", ""),
)
def test_a_forged_composition_is_refused_for_what_it_is(
    files: Files, tmp_path: Path, forge: Callable[[Files], None], reason: str
) -> None:
    with refusals.refused(reason):
        decided(rebound(forged_by(forge, files), tmp_path))


def test_binding_the_files_again_as_they_are_changes_nothing(files: Files, tmp_path: Path) -> None:
    again = json.loads(json.dumps(files))
    assert decided(rebound(again, tmp_path)).margin > 0


def test_a_stage_goal_may_not_be_shrunk(files: Files, tmp_path: Path) -> None:
    forged = json.loads(json.dumps(files))
    goal = forged["stage3.proof.json"]["claim"]["goal"]
    goal["P"] = (1.02 * np.array(goal["P"])).tolist()
    with refusals.refused("not_definite"):
        decided(rebound(forged, tmp_path))


def test_another_file_in_a_stages_place_is_refused_by_its_digest(
    files: Files, tmp_path: Path
) -> None:
    for name, document in files.items():
        (tmp_path / name).write_bytes(documents.encode(document))
    (tmp_path / "stage1.funnel.json").write_bytes(documents.encode(files["stage2.funnel.json"]))
    with pytest.raises(
        CertificateMismatch, match=r"stage1: stage1\.funnel\.json is not the funnel"
    ):
        decided(tmp_path / "composition.proof.json")
    (tmp_path / "stage1.proof.json").write_bytes(documents.encode(files["stage2.proof.json"]))
    with pytest.raises(CertificateMismatch, match=r"stage1\.proof\.json is not the stage1"):
        decided(tmp_path / "composition.proof.json")
