"""Funnels that follow each other: one claim over their files, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid import ContinuousTracking, Goal, Nominal, VectorField, check, integrate_nominal
from nlsid_core import files as documents
from nlsid_core.design import compose_funnels, design_funnel
from nlsid_core.errors import CertificateMismatch, DataError, Infeasible
from nlsid_core.proofs import decide
from tests.core.kernel import refusals
from tests.edits import Edit, both, exchanged, put, scaled, without
from tests.funnel_files import Files, copy_of, forged_by, read
from tests.marks import slow_among
from tests.verbs import nlsid


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
    return read(folder)


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


WHOLE = "composition.proof.json"
ABOUT, MULTIPLIERS = f"{WHOLE} claim about", f"{WHOLE} proof multipliers"
FORGERIES: dict[str, tuple[Edit, str]] = {
    "stages 1 and 2 exchanged": (exchanged(f"{ABOUT} stage1", f"{ABOUT} stage2"), "not_covered"),
    # Stage 1 no longer ends inside it.
    "stage 2 starts narrower": (scaled("stage2.funnel.json rho 0", 0.99), "not_definite"),
    "stage 2 has the third's funnel": (
        exchanged("stage2.funnel.json", "stage3.funnel.json"),
        "mismatch",
    ),
    "a multiplier less": (without(f"{MULTIPLIERS} -1"), "malformed"),
    "from 1 to 2 s no funnel": (
        both(
            put(f"{ABOUT} stage2 file", "stage3.proof.json"),
            without(f"{ABOUT} stage3"),
            without(f"{MULTIPLIERS} -1"),
        ),
        "not_covered",
    ),
    # Past 1 the S-lemma gives nothing.
    "a multiplier above 1": (put(f"{MULTIPLIERS} 0", 1.01), "not_definite"),
    "stage 2's proof is stage 1's": (
        put(f"{ABOUT} stage2 file", "stage1.proof.json"),
        "not_covered",
    ),
    "the last goal smaller": (scaled("stage3.proof.json claim goal P", 1.02), "not_definite"),
    "multipliers without end": (put(MULTIPLIERS, [0.5] * 100_000), "too_large"),
}


def rebound(files: Files) -> None:
    """Every digest made to fit again, as a forger would; those inside of the stages as they are."""
    for name in (*(f"stage{i}.proof.json" for i in (1, 2, 3)), WHOLE):
        for binding in files[name]["claim"]["about"].values():
            binding["digest"] = documents.digest(files[binding["file"]])


@pytest.mark.parametrize("what", slow_among(FORGERIES, {"multipliers without end"}))
def test_a_forged_composition_is_refused_for_what_it_is(files: Files, what: str) -> None:
    forge, reason = FORGERIES[what]
    forged = forged_by(forge, files)
    rebound(forged)
    with refusals.refused(reason):
        decide(forged[WHOLE], forged)


def test_binding_the_files_again_as_they_are_changes_nothing(files: Files) -> None:
    again = copy_of(files)
    rebound(again)
    assert again == files
    assert decide(again[WHOLE], again).margin > 0


def test_another_file_in_a_stages_place_is_refused_by_its_digest(files: Files) -> None:
    for name, said in (
        ("funnel", r"stage1: stage1\.funnel\.json is not the funnel"),
        ("proof", r"stage1\.proof\.json is not the stage1"),
    ):
        forged = files | {f"stage1.{name}.json": files[f"stage2.{name}.json"]}
        with pytest.raises(CertificateMismatch, match=said):
            decide(forged[WHOLE], forged)
