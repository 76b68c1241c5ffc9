"""What a proof file of version 2 is about: its numbers, by kind of claim, with nothing decided.

The files that it binds are read with it. What the second kernel does not cover is told by name
(NotCovered); what the pages do not allow is refused (strict*.py). Standard library only.
"""

import hashlib
import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import strict
import strict_funnels
from strict import Refused

DIGITS = 60  # characters of a number

Files = dict[str, tuple[str, Any]]  # text and content, by role


class NotCovered(Exception):  # noqa: N818 - says what the second kernel does not decide
    """What the file has and the second kernel does not cover; or what is wrong with the file."""


class Funnel:
    """The numbers of a continuous funnel: what the theorem is about, and its witness."""

    def __init__(self, document: Any, content: str, folder: Path) -> None:
        self.claim, self.proof = document["claim"], document["proof"]
        self.files: Files = {"proof": (content, document)}
        roles = "vector_field policy funnel"
        if "decay" in self.claim:
            raise NotCovered("a decay")
        files, digests = _bound(self.claim.get("about"), folder, roles, self.files)
        strict_funnels.flow(self.files)
        self.field, self.policy, self.funnel = files
        if any(file["vector_field"] != digests["vector_field"] for file in files[1:]):
            raise Refused("a file names another vector field")
        if self.funnel["policy"] != digests["policy"]:
            raise Refused("the funnel names another policy")
        inputs = [row[0] for row in self.policy["limits"]]
        if inputs != sorted(inputs):
            raise NotCovered("limits that are not sorted by input")
        self.intervals = len(self.funnel["t"]) - 1
        self.kappa = self.proof.get("kappa", [[]] * self.intervals)
        errors = [0.0] * self.field["states"]
        self.period, self.errors = self.claim.get("hold", 0), self.claim.get("error", errors)
        self.held = "hold" in self.claim or any(self.errors)
        if "error" in self.claim and not self.held:
            raise NotCovered("an error of 0 in every state")


class Composition:
    """The numbers of funnels that follow each other, and the multipliers between them."""

    def __init__(self, document: Any, content: str, folder: Path) -> None:
        self.files: Files = {"proof": (content, document)}
        self.multipliers = strict_funnels.composition(document)
        roles = [f"stage{i}" for i in range(1, len(self.multipliers) + 2)]
        _bound(document["claim"]["about"], folder, " ".join(roles), self.files)
        self.stages = []
        for role in roles:
            text, stage = self.files.pop(role)
            if strict.proof_of(stage, role) != "continuous_funnel":
                raise Refused(f"{role} should claim a continuous_funnel")
            self.stages.append(Funnel(stage, text, folder))
            if "hold" in stage["claim"]:
                raise Refused(f"{role} has a hold")
            if self.stages[-1].held:
                raise NotCovered("an error of a stage")
            self.files |= {f"{role}.{part}": file for part, file in self.stages[-1].files.items()}


class Sampled:
    """The numbers of a sampled funnel of an explicit model, and its witnesses."""

    def __init__(self, document: Any, content: str, folder: Path) -> None:
        self.files: Files = {"proof": (content, document)}
        about, roles = document["claim"].get("about"), "model policy funnel"
        (self.model, self.policy, self.funnel), digests = _bound(about, folder, roles, self.files)
        strict_funnels.sampled(self.files)
        if any(file["model"] != digests["model"] for file in (self.policy, self.funnel)):
            raise Refused("a file names another model")
        if self.funnel["policy"] != digests["policy"]:
            raise Refused("the funnel names another policy")
        self.proof = document["proof"]


def _load(content: bytes, name: str) -> Any:
    if len(content) > strict.BYTES:
        raise Refused(f"{name} has more than {strict.BYTES} bytes")

    def members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) != len(pairs):
            raise Refused(f"{name}: a member occurs twice")
        return dict(pairs)

    try:
        document = json.loads(
            content.decode(),
            object_pairs_hook=members,
            parse_int=_integer,
            parse_float=_float,
            parse_constant=_constant,
        )
    except (ValueError, RecursionError) as error:
        raise Refused(f"{name} is not JSON: {error}") from error
    version = document.get("version") if type(document) is dict else None
    if type(version) is not int or version != 2:
        raise Refused(f"{name} is not of version 2")
    return document


def _integer(text: str) -> int:
    if len(text) > DIGITS:
        raise Refused(f"a number of more than {DIGITS} characters")
    if abs(int(text)) > strict.MOST:
        raise Refused(f"{text} is a whole number beyond 2^53")
    return int(text)


def _float(text: str) -> float:
    """A float64, as its shortest decimal form or an equal number."""
    value = float(text)
    if len(text) > DIGITS or math.isinf(value) or Decimal(text) != Decimal(repr(value)):
        raise Refused(f"{text[:DIGITS]} is not written as a float64")
    return value


def _constant(text: str) -> float:
    raise Refused(f"{text} is not a number")


def _bound(
    about: dict[str, Any], folder: Path, roles: str, texts: Files
) -> tuple[list[Any], dict[str, str]]:
    """The files of these roles, by digests of their bytes; their text and content go to `texts`."""
    strict.members(about, "about", roles)
    files: list[Any] = []
    digests = {}
    for role in roles.split():
        strict.members(about[role], role, "file digest")
        name = strict.text(about[role]["file"], role)
        if not name or any(sign in name for sign in "/\\:") or not (folder / name).is_file():
            raise Refused(f"{name!r} is not the name of a file beside the proof")
        content = (folder / name).read_bytes()
        digests[role] = "sha256:" + hashlib.sha256(content).hexdigest()
        if digests[role] != about[role]["digest"]:
            raise Refused(f"{name} is not the file that the proof is about")
        files.append(_load(content, name))
        texts[role] = content.decode(), files[-1]
        if sum(len(text.encode()) for text, _ in texts.values()) > strict.TOGETHER:
            raise Refused(f"the files have more than {strict.TOGETHER} bytes together")
    return files, digests


class Increments:
    """The numbers of a model, and of tubes around it or of its stability, with the multipliers."""

    def __init__(self, document: Any, content: str, folder: Path) -> None:
        self.files: Files = {"proof": (content, document)}
        self.tubes: list[Any] | None = None
        self.policy: Any = None
        self.boxed = False
        claim, proof = document["claim"], document["proof"]
        about = claim.get("about")
        stable = claim["kind"] == "stability"
        planned = type(about) is dict and "policy" in about and not stable
        roles = "model" if stable else "model policy funnel" if planned else "model funnel"
        (self.model, *others), digests = _bound(about, folder, roles, self.files)
        given = others[-1].get("tubes") if others else None
        if type(given) is list and any("direct" in tube for tube in given if type(tube) is dict):
            raise NotCovered("a part of an innovation that is direct")
        strict.held(self.files)
        if any(entry["model"] != digests["model"] for entry in others):
            raise Refused("a file names another model")
        if stable:
            self.P, self.rate = proof["P"], claim["rate"]
            self.trees = [proof.get("multipliers")]
            return
        if planned:
            self.policy = others[0]
            if others[1]["policy"] != digests["policy"]:
                raise Refused("the funnel names another policy")
        self.boxed = "box" in others[-1]
        self.tubes = others[-1]["tubes"]
        self.trees = proof.get("multipliers", [None] * len(self.tubes))


Problem = Funnel | Increments | Sampled | Composition


def read(path: Path) -> Problem:
    """The numbers of a proof file of a kind that is covered."""
    content = path.read_bytes()
    document = _load(content, path.name)
    kind = strict.proof_of(document, path.name)
    if kind in ("tube", "stability"):
        return Increments(document, content.decode(), path.parent)
    if kind == "sampled_funnel":
        return Sampled(document, content.decode(), path.parent)
    if kind == "funnel_composition":
        return Composition(document, content.decode(), path.parent)
    if kind != "continuous_funnel":
        raise NotCovered(f"claims of kind {kind} are not covered by the second kernel")
    return Funnel(document, content.decode(), path.parent)
