"""Structured damage to a corpus of proofs, and what the kernel and the oracles say of it.

The corpus is one folder for each case, corpus/<kind>/<name>: `claim.proof.json` and the files that
it is about. Any part may change, and an adversary who changes a file binds it again. Every kind has
an oracle, which decides a mutant that was proved a second time, whole.
"""

import contextlib
import json
import math
import pickle
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from nlsid_core import files, kernel
from nlsid_core.arrays import Json
from nlsid_core.kernel import Rejected
from tests.core.kernel import (
    oracle_composition,
    oracle_continuous,
    oracle_polynomial,
    oracle_sampled,
    oracle_stability,
    oracle_tube,
)

CORPUS = Path(__file__).parent / "corpus"
PROOF = "claim.proof.json"
# Kind: whether the claim of a document about these files is proved, by independent arithmetic.
ORACLES: dict[str, Callable[[Json, Mapping[str, Json]], bool]] = {
    "stable_set": oracle_polynomial.agrees,
    "stability": oracle_stability.agrees,
    "tube": oracle_tube.agrees,
    "sampled_funnel": oracle_sampled.agrees,
    "continuous_funnel": oracle_continuous.agrees,
    "funnel_composition": oracle_composition.agrees,
}
WILD: tuple[Any, ...] = (
    0,
    -0.0,
    1,
    -1,
    1e-300,
    5e-324,
    1e300,
    1.7976931348623157e308,
    2**53,
    1e-12,
    True,
    None,
    "1/3",
    "-7",
    "1e5",
    "nan",
    "",
    [],
    {},
    "9" * 100,
)


@dataclass(frozen=True)
class Case:
    """A proof document and the files it is about, all changeable copies."""

    kind: str
    name: str
    document: Json
    about: dict[str, Json]

    def copied(self) -> "Case":
        return Case(self.kind, self.name, *pickle.loads(pickle.dumps((self.document, self.about))))


@cache
def corpus() -> tuple[Case, ...]:
    """Every case, in the order of their names."""
    cases = []
    for path in sorted(CORPUS.glob(f"*/*/{PROOF}")):
        document = files.load_document(path)
        others = sorted(set(path.parent.glob("*.json")) - {path})
        about = {other.name: files.load_document(other) for other in others}
        cases.append(Case(path.parent.parent.name, path.parent.name, document, about))
    return tuple(cases)


@lru_cache(maxsize=512)
def _encoded(pickled: bytes) -> bytes:
    return files.encode(pickle.loads(pickled))


def encoded(document: Json) -> bytes:
    """As it is saved: most files of a mutant are those of its case, and are not written again."""
    return _encoded(pickle.dumps(document))


def decide(case: Case) -> str:
    """`proved`, `rejected`, or `not decided` for a refusal that no reason was meant for."""
    try:
        contents = {name: encoded(about) for name, about in case.about.items()}
        kernel.decide(encoded(case.document), lambda name: contents[name])
    except Rejected as refusal:
        return "not decided" if str(refusal).startswith("not decided") else "rejected"
    except (ValueError, TypeError):  # a document that cannot even be written
        return "rejected"
    return "proved"


def mutant(case: Case, rng: np.random.Generator) -> Case:
    """A copy with one to three changes."""
    forged = case.copied()
    for _ in range(int(rng.integers(1, 4))):
        parts = [forged.document["proof"], forged.document["claim"], *forged.about.values()]
        _change(parts[rng.integers(len(parts))], rng)
        if rng.random() < 0.05:
            _exchange_files(forged, rng)
    bind_again(forged)
    return forged


def moved(case: Case, rng: np.random.Generator) -> Case:
    """A copy with one number moved, by a little or by its size; what is symmetric stays so."""
    forged = case.copied()
    parts = [forged.document["proof"], forged.document["claim"], *forged.about.values()]
    leaves = [[(o, k) for o, k in _leaves(part) if type(o[k]) is float] for part in parts]
    chosen = [part for part in leaves if part]
    numbers = chosen[rng.integers(len(chosen))]
    owner, key = numbers[rng.integers(len(numbers))]
    owner[key] *= 1.0 + float(10.0 ** rng.uniform(-10, 1) * rng.choice((-1, 1)))
    for entries in (each for part in parts for each in _containers(part)):
        for name in ("P", "R") if isinstance(entries, dict) else ():
            _made_symmetric(entries.get(name))
    bind_again(forged)
    return forged


def _made_symmetric(part: Any) -> None:
    """A matrix, or each of a list of them."""
    if not isinstance(part, list) or not isinstance(part[0], list):
        return
    if isinstance(part[0][0], list):
        for each in part:
            _made_symmetric(each)
        return
    for i, j in product(range(len(part)), repeat=2):
        part[max(i, j)][min(i, j)] = part[min(i, j)][max(i, j)]


def bind_again(forged: Case) -> None:
    """The digests inside policies and funnels, then those of the claims, as an adversary would."""
    prefixes = {name.removesuffix("funnel.json") for name in forged.about if "funnel" in name}
    for prefix in sorted(prefixes):
        of = "vector_field" if f"{prefix}vector_field.json" in forged.about else "model"
        for name, role in (("policy", of), ("funnel", of), ("funnel", "policy")):
            with contextlib.suppress(ValueError, TypeError, KeyError):
                document = forged.about[f"{prefix}{name}.json"]
                document[role] = files.digest(encoded(forged.about[f"{prefix}{role}.json"]))
    for document in (*forged.about.values(), forged.document):
        claim = document.get("claim")
        bindings = claim.get("about") if isinstance(claim, dict) else None
        for binding in bindings.values() if isinstance(bindings, dict) else ():
            with contextlib.suppress(ValueError, TypeError, KeyError):
                binding["digest"] = files.digest(encoded(forged.about[binding["file"]]))


def run(count: int, rng: np.random.Generator, kinds: Collection[str] = ORACLES) -> dict[str, Any]:
    """Decide `count` mutants of `kinds`; `false_proved` counts those that an oracle does not prove.

    judged: by kind, how many were proved and then decided by its oracle.
    """
    outcomes = dict.fromkeys(("proved", "rejected", "not decided", "false_proved"), 0)
    judged = dict.fromkeys(ORACLES, 0)
    cases = [case for case in corpus() if case.kind in kinds]
    for k in range(count):
        original = cases[k % len(cases)]
        forged = mutant(original, rng)
        found = decide(forged)
        outcomes[found] += 1
        if found == "proved":
            judged[original.kind] += 1
            outcomes["false_proved"] += not ORACLES[original.kind](forged.document, forged.about)
    return {**outcomes, "judged": judged}


def _exchange_files(forged: Case, rng: np.random.Generator) -> None:
    """The files, or the proof, of another case of this kind in the place of its own."""
    others = [case for case in corpus() if case.kind == forged.kind and case.name != forged.name]
    if not others:
        return
    other = others[rng.integers(len(others))].copied()
    if rng.random() < 0.5:
        forged.document["proof"] = other.document["proof"]
    else:
        forged.about.update(other.about)


def _change(part: Any, rng: np.random.Generator) -> None:
    numbers = [place for place in _leaves(part) if type(place[0][place[1]]) in (int, float)]
    lists = [entries for entries in _containers(part) if isinstance(entries, list) and entries]
    objects = [entries for entries in _containers(part) if isinstance(entries, dict) and entries]
    kind = rng.choice(
        [
            "ulp",
            "digit",
            "step",
            "sign",
            "wild",
            "order",
            "drop",
            "swap",
            "shift",
            "members",
            "rename",
        ]
    )
    if kind in ("ulp", "digit", "step", "sign", "wild") and numbers:
        owner, key = numbers[rng.integers(len(numbers))]
        owner[key] = _other(owner[key], str(kind), rng)
    elif kind in ("order", "drop", "swap", "shift") and lists:
        chosen = lists[rng.integers(len(lists))]
        i, j = rng.integers(len(chosen), size=2)
        if kind == "order":
            chosen.reverse()
        elif kind == "drop":
            del chosen[i]
        elif kind == "swap":
            chosen[i], chosen[j] = chosen[j], chosen[i]
        else:
            chosen.append(chosen.pop(0))
    elif objects:
        entries = objects[rng.integers(len(objects))]
        names = list(entries)
        a, b = (names[k] for k in rng.integers(len(names), size=2))
        if kind == "rename":
            entries[a + "_"] = entries.pop(a)
        else:
            entries[a], entries[b] = entries[b], entries[a]


def _other(value: Any, kind: str, rng: np.random.Generator) -> Any:
    if kind == "wild":
        return WILD[rng.integers(len(WILD))]
    if kind == "sign":
        return -value
    if kind == "ulp" and isinstance(value, float):
        return math.nextafter(value, math.inf if rng.random() < 0.5 else -math.inf)
    if kind == "digit":
        shown = repr(value)
        places = [k for k, sign in enumerate(shown) if sign.isdigit()]
        k = places[rng.integers(len(places))]
        try:
            changed = json.loads(shown[:k] + str(rng.integers(10)) + shown[k + 1 :])
        except ValueError:
            return value
        return changed if math.isfinite(changed) else value
    if isinstance(value, float):
        changed = value * (1.0 + float(10.0 ** rng.uniform(-16, 1) * rng.choice([-1, 1])))
        return changed if math.isfinite(changed) else value
    return value + int(rng.choice([-1, 1]))


def _leaves(part: Any) -> Iterator[tuple[Any, Any]]:
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in list(items):
        if isinstance(value, (dict, list)):
            yield from _leaves(value)
        else:
            yield part, key


def _containers(part: Any) -> Iterator[Any]:
    yield part
    for value in part.values() if isinstance(part, dict) else part:
        if isinstance(value, (dict, list)):
            yield from _containers(value)
