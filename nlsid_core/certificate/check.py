"""`check`: rebuild the claim of a proof file from the files it is about, and decide it."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import (
    attraction,
    block_cascade,
    discrete_funnel,
    implicit,
    monotone_equation,
    nonnegative,
    stability,
    state_affine,
    tube,
)
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.verdict import Decision, Verdict
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, Undecided

FORMAT = "nlsid/proof"
VERSION = 1

Decide = Callable[[Json, Json, Mapping[str, Json], Mode], Decision]


def _exact_only(decide: Callable[[Json, Json, Mapping[str, Json]], Decision]) -> Decide:
    def decided(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
        if mode != "exact":
            raise Undecided(f"a claim of this kind is decided in mode exact only, not {mode}")
        return decide(claim, proof, about)

    return decided


def _trajectory_funnel(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    # Imported when needed: the nouns it is about read their polynomials with this package.
    from nlsid_core.certificate import trajectory_funnel

    return trajectory_funnel.decide(claim, proof, about, mode)


CLAIMS: Mapping[str, Decide] = MappingProxyType(
    {
        "incremental_stability": _exact_only(stability.decide),
        "energy_tube": _exact_only(tube.decide),
        "discrete_funnel": discrete_funnel.decide,
        "state_affine_stability": _exact_only(state_affine.decide),
        "block_cascade_stability": _exact_only(block_cascade.decide),
        "monotone_equation_stability": _exact_only(monotone_equation.decide),
        "polynomial_bound": nonnegative.decide_lower_bound,
        "matrix_inequality": nonnegative.decide_matrix,
        "region_of_attraction": attraction.decide,
        "implicit_stability": implicit.decide,
        "well_posedness": implicit.decide_well_posed,
        "trajectory_funnel": _trajectory_funnel,
    }
)


def check(path: Path | str, *, mode: Mode = "exact") -> Verdict:
    """Decide the claim in the proof file `path` from the files it names in the same folder.

    Mode `exact` computes in integers and rationals, `rigorous` in floating point with proved
    bounds. Returns a Verdict if, and only if, the claim is proved. Raises CertificateMismatch if a
    file beside it is not the one the proof is about, Undecided if this mode cannot tell,
    CertificateRejected if the proof is damaged, incomplete or does not prove its claim; the
    message says why. OS errors for `path` itself pass through.
    """
    started = time.perf_counter()
    if mode not in ("exact", "rigorous"):
        raise ValueError(f"mode is {mode!r}; known: exact, rigorous")
    path = Path(path)
    try:
        document = _json.load_document(path)
        _json.header(document, FORMAT, VERSION, source=path.name)
        _refuse_damage(document, path.name)
        claim = _json.member(document, "claim", dict, source=path.name)
        proof = _json.member(document, "proof", dict, source=path.name)
        kind = _json.member(claim, "kind", str, source=path.name)
        if kind not in CLAIMS:
            raise CertificateRejected(f"claim '{kind}' is unknown; known: {', '.join(CLAIMS)}")
        about = _files_named_in(claim, path)
        decision = CLAIMS[kind](claim, proof, about, mode)
    except (DataError, ValueError, ArithmeticError) as error:
        if isinstance(error, CertificateRejected):
            raise
        raise CertificateRejected(str(error)) from error
    return Verdict(
        statement=decision.statement,
        margin=decision.margin,
        assumptions=decision.assumptions,
        mode=mode,
        digests={role: _json.digest(content) for role, content in about.items()},
        seconds=time.perf_counter() - started,
    )


def proof_document(claim: Json, proof: Json) -> Json:
    """The proof file's content: claim, proof, and a digest over both that shows damage."""
    document: Json = {"format": FORMAT, "version": VERSION, "claim": claim, "proof": proof}
    return document | {"digest": _json.digest(document)}


def _refuse_damage(document: Json, source: str) -> None:
    stated = _json.member(document, "digest", str, source=source)
    content = {key: value for key, value in document.items() if key != "digest"}
    if _json.digest(content) != stated:
        raise CertificateRejected(f"{source}: content does not match its own digest (damaged)")


def _files_named_in(claim: Json, path: Path) -> dict[str, Json]:
    """Load every file the claim is about from the proof's folder and compare its digest."""
    about: dict[str, Json] = {}
    for role, binding in _json.member(claim, "about", dict, source=path.name).items():
        if not isinstance(binding, dict):
            raise CertificateRejected(f"{path.name}: '{role}' should name a file and its digest")
        name = _json.member(binding, "file", str, source=f"{path.name} {role}")
        stated = _json.member(binding, "digest", str, source=f"{path.name} {role}")
        if not name or Path(name).name != name or "\\" in name or "\0" in name:
            raise CertificateRejected(f"{path.name}: {role} file '{name}' is not a plain file name")
        try:
            about[role] = _json.load_document(path.parent / name)
        except OSError as error:
            raise CertificateMismatch(f"{role} file {name} cannot be read: {error}") from error
        found = _json.digest(about[role])
        if found != stated:
            raise CertificateMismatch(
                f"{name} is not the {role} this proof is about: "
                f"digest {found[:23]}..., proof says {stated[:23]}..."
            )
    return about
