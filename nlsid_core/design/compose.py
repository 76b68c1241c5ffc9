"""`compose_funnels`: funnels in files that follow each other in time, and the proof that they fit.

Source: thesis Section 5.1.3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.designs import COMPOSITION
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside

KIND, STAGE_KIND = "funnel_composition", "continuous_funnel"
ROLES = ("vector_field", "policy", "funnel")
LARGEST = 1e6  # overlap factor past which the search for it stops


def compose_funnels(paths: Sequence[Path | str], folder: Path | str) -> Path:
    """Bind the funnels of these proof files, in this order, into one claim that `check` decides.

    Copies every stage's four files to `folder`, named stage1.policy.json and so on, each still a
    proof of its own, and writes composition.proof.json, whose path is returned.

    Raises CertificateRejected or CertificateMismatch if a proof is not one of a funnel or its files
    are not beside it, DataError if stages do not follow each other in time, Infeasible if one does
    not end inside the next: the message says by how much.
    """
    if len(paths) < 2:
        raise DataError(f"a composition needs two or more funnels, got {len(paths)}")
    stages = [read_stage(i, Path(path)) for i, path in enumerate(paths, start=1)]
    steps = enumerate(pairwise(stages), start=1)
    multipliers = [_multiplier(i, before, after) for i, (before, after) in steps]
    contents = {name: content for stage in stages for name, content in stage.contents.items()}
    about = {
        f"stage{stage.number}": {
            "file": f"stage{stage.number}.proof.json",
            "digest": files.digest(stage.contents[f"stage{stage.number}.proof.json"]),
        }
        for stage in stages
    }
    claim = {"kind": KIND, "about": about}
    document = proofs.proof_document(claim, {"multipliers": multipliers})
    proofs.decide(document, contents)
    write_beside(Path(folder), contents, [Path(path) for path in paths])
    files.write_document(Path(folder) / COMPOSITION, document)
    return Path(folder) / COMPOSITION


def write_beside(folder: Path, contents: Mapping[str, bytes], sources: Sequence[Path]) -> None:
    """Write the files; DataError before any is, if one would replace a file beside a source."""
    for source in sources:
        for name, content in contents.items():
            old = source.parent / name
            same = old.is_file() and folder.is_dir() and old.parent.samefile(folder)
            if same and old.read_bytes() != content:
                raise DataError(f"{old} is there and would be replaced: choose another folder")
    for name, content in contents.items():
        files.write_atomically(folder / name, content)


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage's files by their names in the composition, its proof about these names."""

    number: int
    path: Path
    funnel: ContinuousFunnel
    contents: dict[str, bytes]


def read_stage(number: int, path: Path) -> Stage:
    """The funnel of a proof file and the files beside it; raises as `compose_funnels`."""
    document = files.load_document(path)
    claim = document.get("claim")
    about = claim.get("about") if isinstance(claim, dict) else None
    if (
        not isinstance(claim, dict)
        or claim.get("kind") != STAGE_KIND
        or not isinstance(about, dict)
    ):
        raise CertificateRejected(f"{path} is no proof of a continuous funnel")
    contents: dict[str, bytes] = {}
    renamed: Json = {}
    for role in ROLES:
        name = files.member(about.get(role, {}), "file", str, source=f"{path} {role}")
        beside = path.parent / name
        if beside.name != name or not beside.is_file():
            raise CertificateMismatch(f"{path}: the {role} file {name!r} is not beside it")
        contents[f"stage{number}.{role}.json"] = beside.read_bytes()
        renamed[role] = about[role] | {"file": f"stage{number}.{role}.json"}
    own = document | {"claim": claim | {"about": renamed}}
    contents[f"stage{number}.proof.json"] = files.encode(own)
    funnel = files.parse_document(contents[f"stage{number}.funnel.json"], source=str(path))
    return Stage(number, path, ContinuousFunnel.from_document(funnel, source=str(path)), contents)


def _multiplier(number: int, before: Stage, after: Stage) -> float:
    """The S-lemma's multiplier for this step."""
    a, b = before.funnel, after.funnel
    if a.n != b.n or a.tf != b.t0:
        raise DataError(
            f"{after.path} ({b.n} states, from {b.t0!r} s) does not follow {before.path} ({a.n} "
            f"states, until {a.tf!r} s)"
        )
    found = _inside(a, b, 1.0)
    if found is None:
        low, high = 1.0, 2.0
        while high < LARGEST and _inside(a, b, high) is None:
            low, high = high, 2 * high
        while high / low > 1.001:
            middle = (low * high) ** 0.5
            low, high = (middle, high) if _inside(a, b, middle) is None else (low, middle)
        raise Infeasible(
            f"stage {number} does not end inside stage {number + 1}: V of the next reaches "
            f"{high:.4g} on its end, at {a.tf:g} s. Design it with the next one's start as its "
            "goal (Goal.start_of)"
        )
    return found


def _inside(a: ContinuousFunnel, b: ContinuousFunnel, level: float) -> float | None:
    """A multiplier for {a at its end} ⊂ {V_b ≤ level at b's start}."""
    return ellipsoid_inside(
        a.x.ends()[-1], a.P[-1] / a.rho[-1], b.x.ends()[0], b.P[0] / (b.rho[0] * level)
    )
