"""Falsification certificates: what a tube assumes cannot hold on samples of a recording.

`falsify` makes one of a bag; the kernel has decided it before it is returned. `recorded` holds one
against the bag again: whether the recording is that one, and its samples those that it states.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bags.designs import documents
from bags.designs.design import WiredTube
from bags.monitoring.replay import Definitions, samples_of
from bags.recordings.folders import trial_name
from bags.recordings.remote import place
from bags.signals.reader import bag_digest
from bags.signals.sampling import Sample
from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DocumentError
from nlsid_core.kernel import Verdict
from nlsid_core.running.falsification import falsifications, refuse_unfalsifiable
from nlsid_core.running.grid import TOLERANCE

__all__ = ["Certificate", "falsified", "falsify", "recorded", "refuse_unfalsifiable"]

SUFFIX = ".falsification.json"


@dataclass(frozen=True, eq=False)
class Certificate:
    """A falsification, the files of the design that it is about by their names, and the verdict."""

    document: Json
    about: dict[str, bytes]
    verdict: Verdict

    def save(self, folder: Path, name: str) -> Path:
        """Write it to `folder`, the design's files beside it; its path, NAME.falsification.json."""
        folder.mkdir(parents=True, exist_ok=True)
        for beside, content in self.about.items():
            files.write_atomically(folder / beside, content)
        files.write_document(folder / f"{name}{SUFFIX}", self.document)
        return folder / f"{name}{SUFFIX}"


def falsify(
    funnel: Path, bag: Path | str, *, definitions: Definitions | None = None
) -> Certificate | None:
    """A certificate that a recording breaks what the tube at `funnel` assumes; None: not found.

    `funnel` has its proof, model and policy beside it. None is no verdict: another window, another
    tube or weights that were not tried may show it. Raises DataError for a model that is not affine
    in its states, DocumentError for a funnel of another kind, BagError as `samples_of`.
    """
    design = documents.load_proved_funnel(funnel).design
    proof = funnel.with_name(documents.FUNNEL_PROOF)
    about = {proof.name: proof.read_bytes()}
    bindings = files.parse_document(about[proof.name], source=proof.name)["claim"]["about"]
    for binding in bindings.values():
        about[binding["file"]] = proof.with_name(binding["file"]).read_bytes()
    tube = {"file": proof.name, "digest": files.digest(about[proof.name])}
    recording = {"name": trial_name(place(bag)), "digest": bag_digest(bag)}
    for begins, y, u in _runs(design, samples_of(design, bag, definitions)):
        for found in falsifications(design.model, design.funnel, y, u, begins):
            document = proofs.proof_document(found.claim({"tube": tube}, recording), found.proof())
            try:
                return Certificate(document, about, proofs.decide(document, about))
            except CertificateRejected:
                continue  # too narrow for exact numbers, or too long
    return None


def falsified(
    funnel: Path, bag: Path, folder: Path, definitions: Definitions | None = None
) -> Iterator[str]:
    """`falsify`, its certificate saved in `folder`, in words."""
    found, name = falsify(funnel, bag, definitions=definitions), trial_name(bag)
    if found is None:
        yield f"{name}: no certificate was found: some start of the observer may explain it"
        return
    yield f"{name}: {found.verdict}"
    yield f"wrote {found.save(folder, name)}"


def recorded(path: Path, bag: Path | str, *, definitions: Definitions | None = None) -> str:
    """What a certificate states of the bag, in words, if that is so; CertificateMismatch if not.

    Decides nothing else: `proofs.check` does. Raises DocumentError if it is no falsification.
    """
    claim = files.member(files.load_document(path), "claim", dict, source=str(path))
    if claim.get("kind") != "falsification":
        raise DocumentError(f"{path}: only a falsification is about samples of a recording")
    proof = path.with_name(claim["about"]["tube"]["file"])
    inner = files.member(files.load_document(proof), "claim", dict, source=str(proof))
    design = documents.load_proved_funnel(path.with_name(inner["about"]["funnel"]["file"])).design
    if bag_digest(bag) != claim["recording"]["digest"]:
        raise CertificateMismatch(f"{bag} is another recording: it has another digest")
    run, first, y, u = (claim[key] for key in ("run", "first", "y", "u"))
    found = samples_of(design, bag, definitions)[run : run + len(u)]
    same = [list(s.u) for s in found] == u and [list(s.y) for s in found[first - run :]] == y
    consecutive = [*_runs(design, found)]
    if not same or len(consecutive) != 1 or not np.isfinite(consecutive[0][1][first - run :]).all():
        raise CertificateMismatch(
            f"{bag}: samples {run} to {run + len(u) - 1} are not those of the certificate, one "
            "after another"
        )
    return f"samples {run} to {run + len(u) - 1} of {bag} are those that it states"


def _runs(
    design: WiredTube, samples: Sequence[Sample]
) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """(first sample, y, u) of stretches in which every input is known, a period apart.

    y is NaN where nobody measured.
    """
    run: list[Sample] = []
    nobody = (np.nan,) * len(design.signals[0])
    for k, sample in enumerate([*samples, None]):
        known = sample if sample is not None and np.isfinite(sample.u).all() else None
        if run and (known is None or not _follow(run[-1], known, design.period)):
            y = [nobody if s.missing or s.filled else s.y for s in run]
            yield k - len(run), np.array(y), np.array([s.u for s in run])
            run = []
        if known is not None:
            run.append(known)


def _follow(before: Sample, after: Sample, period: float) -> bool:
    """Whether they are a period apart, give or take what a monitor allows."""
    return abs((after.stamp_ns - before.stamp_ns) / 1e9 / period - 1.0) <= TOLERANCE
