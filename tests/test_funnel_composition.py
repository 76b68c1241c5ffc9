"""Funnels that follow each other: one claim over their files, and what is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bags.commands.cli import app
from nlsid_core import _json
from nlsid_core.certificate import check
from nlsid_core.certificate.check import proof_document
from nlsid_core.continuous import Nominal, VectorField
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, Infeasible
from nlsid_core.funnels import Goal, compose_funnels, design_funnel, integrate_nominal

Files = dict[str, Any]
ROLES = ("vector_field", "policy", "funnel")


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
        design = design_funnel(*motion(start, start + 1, damping=damping), goal=goal)
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
    margins = [check(tmp_path / f"stage{i}.proof.json", mode="rigorous").margin for i in (1, 2, 3)]
    for mode in ("rigorous", "exact"):
        verdict = check(path, mode=mode)
        assert verdict.margin == pytest.approx(min(margins), rel=1e-3)
    assert "from 0 to 3 s, changing at 1, 2 s" in verdict.statement
    assert any(text.startswith("stage 3: ") for text in verdict.assumptions)


def test_the_command_line_composes_and_checks(proofs: list[Path], tmp_path: Path) -> None:
    runner = CliRunner()
    made = runner.invoke(app, ["compose", *map(str, proofs[:2]), "--out", str(tmp_path)])
    assert made.exit_code == 0, made.output
    assert "8 files" in made.output
    checked = runner.invoke(app, ["check", str(tmp_path / "composition.proof.json")])
    assert checked.exit_code == 0
    assert "PROVED composition of 2 funnels" in checked.output


def test_stages_in_the_wrong_order_are_not_composed(proofs: list[Path], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not follow"):
        compose_funnels(proofs[::-1], tmp_path)
    with pytest.raises(DataError, match="two or more"):
        compose_funnels(proofs[:1], tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_stage_that_ends_wider_than_the_next_starts_is_told_by_how_much(
    proofs: list[Path], tmp_path: Path
) -> None:
    after = _json.load_document(proofs[1].with_name("funnel.json"))
    goal = np.array(after["P"][0]) / after["rho"][0] / 1.3
    wide = design_funnel(*motion(0.0, 1.0), goal=goal).save(tmp_path / "wide")[-1]
    with pytest.raises(Infeasible, match=r"reaches 1\.28"):  # 1.3 less the room the LQR leaves
        compose_funnels([wide, proofs[1]], tmp_path / "out")


def swapped_order(files: Files) -> None:
    """Stages 1 and 2, proofs and all."""
    for part in (*ROLES, "proof"):
        a, b = f"stage1.{part}.json", f"stage2.{part}.json"
        files[a], files[b] = files[b], files[a]


def start_shrunk(files: Files) -> None:
    """Stage 2 starts 1 % narrower: its own proof no longer fits, and nor does stage 1's end."""
    files["stage2.funnel.json"]["rho"][0] *= 0.99


def other_funnel(files: Files) -> None:
    """Stage 2 has the third stage's funnel, whose proof is another."""
    files["stage2.funnel.json"] = files["stage3.funnel.json"]


def stage_missing(files: Files) -> None:
    """A multiplier less: the claim is then about too many files."""
    files["composition.proof.json"]["proof"]["multipliers"].pop()


def stage_left_out(files: Files) -> None:
    """From 1 to 2 s there is no funnel."""
    for part in (*ROLES, "proof"):
        files[f"stage2.{part}.json"] = files.pop(f"stage3.{part}.json")
        files["composition.proof.json"]["claim"]["about"].pop(f"stage3.{part}")
    files["composition.proof.json"]["proof"]["multipliers"].pop()


def multiplier_raised(files: Files) -> None:
    """Past 1 the S-lemma gives nothing."""
    files["composition.proof.json"]["proof"]["multipliers"][0] = 1.01


def proof_exchanged(files: Files) -> None:
    """Stage 2's proof is a copy of stage 1's."""
    files["stage2.proof.json"] = files["stage1.proof.json"]


def stages_without_end(files: Files) -> None:
    """A million multipliers for three stages."""
    files["composition.proof.json"]["proof"]["multipliers"] = [0.5] * 1_000_000


FORGERIES: list[tuple[Callable[[Files], None], str]] = [
    (swapped_order, "stage 1 ends at 2.0 s, stage 2 starts at 0.0 s"),
    (start_shrunk, "stage 2.*do not represent"),
    (other_funnel, "for another|do not represent|another nominal"),
    (stage_missing, "a funnel_composition of 2 stages"),
    (stage_left_out, "stage 1 ends at 1.0 s, stage 2 starts at 2.0 s"),
    (multiplier_raised, "not proved to end inside stage 2"),
    (proof_exchanged, "about another"),
    (stages_without_end, "of 1000001 stages is about .* 2 to 100 of them"),
]


def rebound(files: Files, folder: Path) -> Path:
    """Every digest made to fit again, as a forger would; stage proofs keep what they are about."""
    about = files["composition.proof.json"]["claim"]["about"]
    for i in (1, 2, 3):
        if f"stage{i}.proof.json" not in files:
            continue
        proof = json.loads(json.dumps(files[f"stage{i}.proof.json"]))
        exchanged = i == 2 and proof == files.get("stage1.proof.json")
        for part in ROLES:
            if not exchanged:
                document = files[f"stage{i}.{part}.json"]
                proof["claim"]["about"][part]["digest"] = _json.digest(document)
        files[f"stage{i}.proof.json"] = proof_document(proof["claim"], proof["proof"])
    for name, binding in about.items():
        binding["digest"] = _json.digest(files[f"{name}.json"])
    whole = files["composition.proof.json"]
    files["composition.proof.json"] = proof_document(whole["claim"], whole["proof"])
    for name, document in files.items():
        (folder / name).write_text(json.dumps(document))
    return folder / "composition.proof.json"


@pytest.mark.parametrize(("forge", "reason"), FORGERIES, ids=lambda f: getattr(f, "__name__", ""))
def test_a_forged_composition_is_refused_for_what_it_is(
    files: Files, tmp_path: Path, forge: Callable[[Files], None], reason: str
) -> None:
    forged = json.loads(json.dumps(files))
    forge(forged)
    with pytest.raises(CertificateRejected, match=reason):
        check(rebound(forged, tmp_path), mode="rigorous")


def test_binding_the_files_again_as_they_are_changes_nothing(files: Files, tmp_path: Path) -> None:
    again = json.loads(json.dumps(files))
    assert check(rebound(again, tmp_path), mode="rigorous").margin > 0


def test_a_stage_goal_may_not_be_shrunk(files: Files, tmp_path: Path) -> None:
    forged = json.loads(json.dumps(files))
    goal = forged["stage3.proof.json"]["claim"]["goal"]
    goal["P"] = (1.02 * np.array(goal["P"])).tolist()
    with pytest.raises(CertificateRejected, match="stage 3: the funnel does not end in the goal"):
        check(rebound(forged, tmp_path), mode="rigorous")


def test_another_file_in_a_stages_place_is_refused_by_its_digest(
    files: Files, tmp_path: Path
) -> None:
    for name, document in files.items():
        (tmp_path / name).write_text(json.dumps(document))
    (tmp_path / "stage1.funnel.json").write_text(json.dumps(files["stage2.funnel.json"]))
    with pytest.raises(CertificateMismatch, match="is not the stage1"):
        check(tmp_path / "composition.proof.json", mode="rigorous")
