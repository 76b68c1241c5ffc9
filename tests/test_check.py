"""What the checker proves, and what it must refuse, with the reason."""

import json
from pathlib import Path

import numpy as np
import pytest

from bags.monitoring.documents import FUNNEL, FUNNEL_PROOF, MODEL, MODEL_PROOF, POLICY
from nlsid_core import _json
from nlsid_core._types import Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from nlsid_core.funnels import TubeDesign
from nlsid_core.identification import Fit
from nlsid_core.models import DifferenceEquation


def rewrite(path: Path, document: Json) -> None:
    path.write_text(json.dumps(document))


def forge(folder: Path, name: str = FUNNEL_PROOF, **files: Json) -> None:
    """Write changed files and a proof that names their digests: only the mathematics can refuse."""
    proof = _json.load_document(folder / name)
    about = proof["claim"]["about"]
    for role, document in files.items():
        rewrite(folder / about[role]["file"], document)
    for role in about:
        current = _json.load_document(folder / about[role]["file"])
        about[role]["digest"] = _json.digest(current)
    rewrite(folder / name, proof_document(proof["claim"], proof["proof"]))


def assuming(funnel: Json, **changes: object) -> Json:
    """The funnel document with its assumption changed."""
    return funnel | {"assumption": funnel["assumption"] | changes}


def rebind(folder: Path) -> tuple[Json, Json, Json]:
    """The three documents, with the digests inside them recomputed."""
    model = _json.load_document(folder / MODEL)
    policy = _json.load_document(folder / POLICY) | {"model": _json.digest(model)}
    funnel = _json.load_document(folder / FUNNEL)
    funnel |= {"model": _json.digest(model), "policy": _json.digest(policy)}
    return model, policy, funnel


def test_both_proofs_are_proved_and_say_of_what(
    design_folder: Path, fit: Fit[DifferenceEquation]
) -> None:
    stability = check(design_folder / MODEL_PROOF)
    assert str(stability).startswith("PROVED incremental stability")
    assert stability.margin == pytest.approx(1 - fit.proof.rate)
    tube = check(design_folder / FUNNEL_PROOF)
    assert str(tube).startswith("PROVED tube: speed stays within")
    assert "innovation energy" in tube.assumptions[0]


@pytest.mark.parametrize("engaged", [0, 1])
def test_the_half_width_bounds_the_output_in_the_tube(design: TubeDesign, engaged: int) -> None:
    model, funnel, rng = design.model, design.funnel, np.random.default_rng(0)
    c = model.C[0] - engaged * model.D * design.policy.K
    root = np.linalg.cholesky(np.linalg.inv(funnel.P))
    direction = rng.standard_normal((20_000, len(model) + 1))
    direction *= np.sqrt(funnel.level) / np.linalg.norm(direction, axis=1, keepdims=True)
    outputs = direction[:, :-1] @ root.T @ c + direction[:, -1]
    assert np.abs(outputs).max() <= funnel.half_width


def test_a_half_width_that_is_too_small_is_rejected(design_folder: Path) -> None:
    funnel = _json.load_document(design_folder / FUNNEL)
    forge(design_folder, funnel=funnel | {"half_width": 0.98 * funnel["half_width"]})
    with pytest.raises(CertificateRejected, match="half-width"):
        check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("name", [MODEL, POLICY, FUNNEL])
def test_a_changed_digit_in_any_number_of_any_file_is_rejected(
    design_folder: Path, name: str
) -> None:
    original = (design_folder / name).read_text()
    digits = [i for i, c in enumerate(original) if c in "12345678"]
    for i in digits[:: max(1, len(digits) // 60)]:
        mutant = original[:i] + str(int(original[i]) + 1) + original[i + 1 :]
        (design_folder / name).write_text(mutant)
        with pytest.raises(CertificateRejected, match=name.removesuffix(".json")):
            check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("name", [MODEL_PROOF, FUNNEL_PROOF])
def test_a_changed_digit_in_a_proof_is_rejected(design_folder: Path, name: str) -> None:
    original = (design_folder / name).read_text()
    for i in [i for i, c in enumerate(original) if c in "12345678"]:
        mutant = original[:i] + str(int(original[i]) + 1) + original[i + 1 :]
        (design_folder / name).write_text(mutant)
        with pytest.raises(CertificateRejected):
            check(design_folder / name)


def test_a_reindented_file_is_the_same_document(design_folder: Path) -> None:
    for name in (MODEL, POLICY, FUNNEL, FUNNEL_PROOF):
        document = _json.load_document(design_folder / name)
        (design_folder / name).write_text(json.dumps(document, indent=7, sort_keys=True))
    assert check(design_folder / FUNNEL_PROOF).margin > 0


def test_a_proof_for_another_model_is_rejected(design_folder: Path) -> None:
    model = _json.load_document(design_folder / MODEL)
    rewrite(design_folder / MODEL, model | {"a": [0.1, 0.1]})
    with pytest.raises(CertificateMismatch, match=r"model.json is not the model"):
        check(design_folder / MODEL_PROOF)


def test_a_funnel_made_for_another_policy_is_rejected(design_folder: Path) -> None:
    policy = _json.load_document(design_folder / POLICY)
    forge(design_folder, policy=policy | {"K": [0.0, 0.0]})
    with pytest.raises(CertificateMismatch, match="funnel was made for another policy"):
        check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("name", [MODEL, POLICY, FUNNEL])
def test_a_missing_file_is_rejected_by_name(design_folder: Path, name: str) -> None:
    (design_folder / name).unlink()
    with pytest.raises(CertificateMismatch, match=name):
        check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("path", [("claim",), ("proof",), ("claim", "about"), ("claim", "kind")])
def test_a_missing_piece_of_the_proof_is_rejected(
    design_folder: Path, path: tuple[str, ...]
) -> None:
    document = _json.load_document(design_folder / FUNNEL_PROOF)
    place = document
    for key in path[:-1]:
        place = place[key]
    del place[path[-1]]
    del document["digest"]
    rewrite(design_folder / FUNNEL_PROOF, document | {"digest": _json.digest(document)})
    with pytest.raises(CertificateRejected, match=f"'{path[-1]}' is missing"):
        check(design_folder / FUNNEL_PROOF)


def test_an_unstable_model_cannot_be_forged_stable(design_folder: Path) -> None:
    model = _json.load_document(design_folder / MODEL)
    forge(design_folder, MODEL_PROOF, model=model | {"a": [1.9, -0.85]})
    with pytest.raises(CertificateRejected, match="does not shrink by the stated rate"):
        check(design_folder / MODEL_PROOF)


@pytest.mark.parametrize("rate", [1.0, 1.5, 0.0, -0.9])
def test_a_rate_that_is_no_decay_is_rejected(design_folder: Path, rate: float) -> None:
    document = _json.load_document(design_folder / MODEL_PROOF)
    claim = document["claim"] | {"rate": rate}
    rewrite(design_folder / MODEL_PROOF, proof_document(claim, document["proof"]))
    with pytest.raises(CertificateRejected, match="0 < rate < 1"):
        check(design_folder / MODEL_PROOF)


def test_a_rate_below_the_slowest_pole_is_rejected(
    design_folder: Path, fit: Fit[DifferenceEquation]
) -> None:
    document = _json.load_document(design_folder / MODEL_PROOF)
    radius = float(np.abs(fit.model.poles).max())
    for factor, proved in ((1.0 + 1e-3, None), (1.0 - 1e-9, False)):
        claim = document["claim"] | {"rate": radius * factor}
        rewrite(design_folder / MODEL_PROOF, proof_document(claim, document["proof"]))
        if proved is False:
            with pytest.raises(CertificateRejected):
                check(design_folder / MODEL_PROOF)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: f | {"level": f["level"] * 0.999}, "is below inlet"),
        (lambda f: f | {"inlet": f["inlet"] * 1.01}, "is below inlet"),
        (lambda f: f | {"P": (1.01 * np.array(f["P"])).tolist()}, "V grows by more than"),
        (lambda f: f | {"P": (-np.array(f["P"])).tolist()}, "not symmetric positive definite"),
        (lambda f: f | {"P": [[1.0, 2.0], [0.0, 1.0]]}, "not symmetric positive definite"),
        (lambda f: f | {"P": [[1.0]]}, "differ in size"),
        (lambda f: assuming(f, budget=1e-9), "below safety_factor"),
        (lambda f: assuming(f, samples=10**6), "the nominal"),
        (lambda f: assuming(f, kind="peak"), "expected 'energy'"),
    ],
)  # fmt: skip
def test_a_forged_funnel_with_right_digests_is_rejected(
    design_folder: Path, change: object, reason: str
) -> None:
    assert callable(change)
    forge(design_folder, funnel=change(_json.load_document(design_folder / FUNNEL)))
    with pytest.raises(CertificateRejected, match=reason):
        check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("key", ["K", "L"])
def test_a_gain_three_times_as_large_with_right_digests_is_rejected(
    design_folder: Path, key: str
) -> None:
    policy = _json.load_document(design_folder / POLICY)
    rewrite(design_folder / POLICY, policy | {key: (3.0 * np.array(policy[key])).tolist()})
    model, policy, funnel = rebind(design_folder)
    forge(design_folder, model=model, policy=policy, funnel=funnel)
    with pytest.raises(CertificateRejected, match="V grows by more than"):
        check(design_folder / FUNNEL_PROOF)


def test_a_nominal_that_does_not_obey_the_model_is_rejected(design_folder: Path) -> None:
    policy = _json.load_document(design_folder / POLICY)
    policy["x"][20][0] += 1e-6
    rewrite(design_folder / POLICY, policy)
    model, policy, funnel = rebind(design_folder)
    forge(design_folder, model=model, policy=policy, funnel=funnel)
    with pytest.raises(CertificateRejected, match="departure from the model"):
        check(design_folder / FUNNEL_PROOF)


def test_a_faster_robot_with_right_digests_is_rejected(design_folder: Path) -> None:
    changed = _json.load_document(design_folder / MODEL)
    rewrite(design_folder / MODEL, changed | {"a": (1.02 * np.array(changed["a"])).tolist()})
    model, policy, funnel = rebind(design_folder)
    forge(design_folder, model=model, policy=policy, funnel=funnel)
    with pytest.raises(CertificateRejected):
        check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("file", ["../model.json", "/etc/hostname", "a/b.json", "", "..\\x"])
def test_a_file_name_that_leaves_the_folder_is_rejected(design_folder: Path, file: str) -> None:
    document = _json.load_document(design_folder / MODEL_PROOF)
    document["claim"]["about"]["model"]["file"] = file
    rewrite(design_folder / MODEL_PROOF, proof_document(document["claim"], document["proof"]))
    with pytest.raises(CertificateRejected, match="not a plain file name"):
        check(design_folder / MODEL_PROOF)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not a valid document"),
        ("[]", "expected a JSON object"),
        ('{"format": "nlsid/model", "version": 1}', "format is 'nlsid/model'"),
        ('{"format": "nlsid/proof", "version": 2}', "version 2"),
        ('{"format": "nlsid/proof", "format": "nlsid/proof"}', "occurs twice"),
        ('{"rate": NaN}', "NaN is not a number"),
        ('{"rate": 1e999}', "does not fit"),
        ('{"x": ' + "[" * 100_000 + "]" * 100_000 + "}", "not a valid document"),
        ("\0" * 1000, "not a valid document"),
    ],
)
def test_what_is_not_a_proof_document_is_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "x.proof.json"
    path.write_text(text)
    with pytest.raises(CertificateRejected, match=reason):
        check(path)


@pytest.mark.parametrize("value", ["1", None, True, [1.0], {"a": 1}])
def test_a_number_of_another_type_is_rejected(design_folder: Path, value: object) -> None:
    document = _json.load_document(design_folder / MODEL_PROOF)
    claim = document["claim"] | {"rate": value}
    rewrite(design_folder / MODEL_PROOF, proof_document(claim, document["proof"]))
    with pytest.raises(CertificateRejected, match="'rate' should be"):
        check(design_folder / MODEL_PROOF)
