"""Bundles of a design: what is true is decided as from its files, everything else is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from bags.designs import bundle as bundles
from bags.designs import documents
from bags.designs.bundle import Bundle
from nlsid_core import deciding, files
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateMismatch, DocumentError
from nlsid_core.proofs import check
from tests.bags.deciding import decide


@pytest.fixture
def bundle(funnel: Path) -> Bundle:
    return Bundle.load(funnel)


def test_a_bundle_is_the_files_byte_for_byte_and_decided_like_them(
    bundle: Bundle, funnel: Path
) -> None:
    read = Bundle.parse(bundle.text())
    assert read == bundle
    names = {"model": documents.MODEL, "policy": documents.POLICY, "funnel": documents.FUNNEL}
    for role, name in (names | {"proof": documents.FUNNEL_PROOF}).items():
        assert read.contents[role] == funnel.with_name(name).read_bytes()
    assert read.decided() == check(funnel.with_name(documents.FUNNEL_PROOF))
    assert read.design().digest == read.digest == files.digest(funnel.read_bytes())
    answer = decide(bundle.text())
    assert (answer["proved"], answer["digest"]) == (str(read.decided()), read.digest)


def with_digit_changed(text: str) -> str:
    at = next(i for i in range(len(text) // 2, len(text)) if text[i] in "12345678")
    return text[:at] + str(int(text[at]) + 1) + text[at + 1 :]


@pytest.mark.parametrize("role", ["model", "policy", "funnel", "proof"])
@pytest.mark.parametrize("damage", ["a digit", "gone", "empty", "another's"])
def test_no_file_can_be_changed_left_out_or_exchanged(
    bundle: Bundle, role: str, damage: str
) -> None:
    contents = dict(bundle.contents)
    if damage == "gone":
        del contents[role]
    elif damage == "empty":
        contents[role] = b""
    elif damage == "another's":
        contents[role] = contents["model" if role != "model" else "policy"]
    else:
        contents[role] = with_digit_changed(contents[role].decode()).encode()
    assert set(decide(Bundle(contents).text())) == {"refused"}


def test_a_file_that_the_proof_is_not_about_is_refused(bundle: Bundle) -> None:
    more = Bundle({**bundle.contents, "vector_field": bundle.contents["model"]})
    with pytest.raises(CertificateMismatch, match="the proof is about funnel, model, policy"):
        more.decided()


def test_a_proof_of_something_else_brings_no_design(funnel: Path, bundle: Bundle) -> None:
    """The model's own proof of stability is a true claim, and about no funnel."""
    proof = funnel.with_name(documents.MODEL_PROOF).read_bytes()
    model = {"proof": proof, "model": bundle.contents["model"]}
    assert "with a funnel come" in decide(Bundle(model).text())["refused"]
    assert "refused" in decide(Bundle({**bundle.contents, "proof": proof}).text())


@pytest.mark.parametrize("name", ["../model.json", "/etc/passwd", "", "."])
def test_a_name_that_is_not_plain_is_not_read(funnel: Path, tmp_path: Path, name: str) -> None:
    proof = files.load_document(funnel.with_name(documents.FUNNEL_PROOF))
    proof["claim"]["about"]["model"]["file"] = name
    for path in funnel.parent.glob("*.json"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    files.write_document(tmp_path / documents.FUNNEL_PROOF, proof)
    loaded = Bundle.load(tmp_path / documents.FUNNEL)
    assert "model" not in loaded.contents
    assert "refused" in decide(loaded.text())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: json.dumps(d | {"format": "nlsid/model"}), "expected 'nlsid/bundle'"),
        (lambda d: json.dumps(d | {"version": 1}), "this nlsid reads version"),
        (lambda d: json.dumps(d | {"files": []}), "'files' should be dict"),
        (lambda d: json.dumps(d | {"files": {"proof": 1}}), "texts by role"),
        (
            lambda d: json.dumps(d | {"files": dict.fromkeys(map(str, range(402)), "")}),
            "at most 401",
        ),
        (lambda _: "[" * 100_000, "not a valid document"),
        (lambda _: "", "not a valid document"),
        (lambda _: " " * (bundles.MAX_BYTES + 1), "one has at most"),
        (lambda d: json.dumps(d | {"files": {"proof": "\ud800"}}), "not a valid document"),
    ],
)
def test_what_is_no_bundle_is_refused_with_the_reason(
    bundle: Bundle, change: Callable[[Json], str], says: str
) -> None:
    assert says in decide(change(json.loads(bundle.text())))["refused"]


def test_a_bundle_too_large_to_be_taken_is_not_made(
    funnel: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundles, "MAX_BYTES", 1000)
    with pytest.raises(DocumentError, match="one has at most 1000"):
        Bundle.load(funnel)


def test_what_was_decided_is_remembered_and_no_other_user_can_write_it(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    kept = tmp_path / "nlsid" / "decided"
    assert not decide(bundle.text())["before"]
    assert decide(bundle.text())["before"]
    (entry,) = kept.iterdir()
    assert kept.stat().st_mode & 0o777 == 0o700
    # the same proof, about another file
    assert "refused" in decide(Bundle({**bundle.contents, "policy": b"{}"}).text())
    lie = json.loads(entry.read_text()) | {"statement": "all is well"}
    entry.write_text(json.dumps(lie))
    for path, mode in ((entry, 0o622), (kept, 0o770)):
        path.chmod(mode)
        answer = decide(bundle.text())
        assert (answer["before"], "all is well" in answer["proved"]) == (False, False)
        entry.chmod(0o600)


def test_nothing_is_remembered_where_the_kernel_changed_meanwhile(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The process that decides reads the sources of its own time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(deciding, "KERNEL", shutil.copytree(deciding.KERNEL, tmp_path / "kernel"))
    source = tmp_path / "kernel" / "text.py"
    before = source.read_text()
    begun = bundle.deciding()
    source.write_text(before + "# another one\n")
    assert begun.wait().statement
    assert not decide(bundle.text())["before"]
    source.write_text(before)
    assert not decide(bundle.text())["before"]


def test_a_linked_proof_is_about_the_files_beside_the_link(funnel: Path, tmp_path: Path) -> None:
    for path in funnel.parent.glob("*.json"):
        if path.name != documents.FUNNEL_PROOF:
            shutil.copy(path, tmp_path)
    (tmp_path / documents.FUNNEL_PROOF).symlink_to(funnel.with_name(documents.FUNNEL_PROOF))
    assert check(tmp_path / documents.FUNNEL_PROOF).statement
    tampered = tmp_path / documents.FUNNEL
    tampered.write_text(with_digit_changed(tampered.read_text()))
    with pytest.raises(CertificateMismatch):
        check(tmp_path / documents.FUNNEL_PROOF)


def test_a_check_can_be_called_off(bundle: Bundle) -> None:
    begun = bundle.deciding()
    begun.close()
    assert begun.seconds >= 0.0
