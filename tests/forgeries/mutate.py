"""Random damage to proof documents, as an adversary who recomputes the digest would do it."""

import copy
import math
from typing import Any

import numpy as np

from nlsid_core import _json
from nlsid_core._types import Json

LEAST = 5e-324
WILD = (0.0, -0.0, 1e-300, LEAST, 1e300, -1e300, 1.7976931348623157e308, 1, -1, 2**62, 1e-12)
ODD: tuple[Any, ...] = ("1/3", "-7", "1e5", "nan", "", "0x10", None, True, [], {}, "9" * 100)


def mutant(document: Json, rng: np.random.Generator) -> Json:
    """A copy with one to three random changes and a digest that fits."""
    forged = copy.deepcopy({k: v for k, v in document.items() if k != "digest"})
    for _ in range(int(rng.integers(1, 4))):
        _change(forged, rng)
    return forged | {"digest": _json.digest(forged)}


def _change(forged: Json, rng: np.random.Generator) -> None:
    part = forged["claim"] if rng.random() < 0.4 else forged["proof"]
    places = list(_leaves(part))
    lists = list(_lists(part))
    kind = rng.choice(["nudge", "wild", "sign", "odd", "reorder", "drop", "swap", "symmetric"])
    if kind in ("reorder", "drop", "swap") and lists:
        chosen = lists[rng.integers(len(lists))]
        if kind == "reorder":
            order = rng.permutation(len(chosen))
            chosen[:] = [chosen[k] for k in order]
        elif kind == "drop" and chosen:
            del chosen[rng.integers(len(chosen))]
        elif len(chosen) > 1:
            i, j = rng.integers(len(chosen), size=2)
            chosen[i], chosen[j] = chosen[j], chosen[i]
        return
    if kind == "symmetric":  # the subtle one: a Gram matrix that stays symmetric
        grams = [gram for gram in _grams(forged["proof"]) if gram["Q"]]
        if grams:
            Q = grams[rng.integers(len(grams))]["Q"]
            i, j = rng.integers(len(Q), size=2)
            if isinstance(Q[i], list) and len(Q[i]) > j and isinstance(Q[i][j], float):
                Q[i][j] = _nudged(Q[i][j], rng)
                Q[j][i] = Q[i][j]
        return
    numbers = [(owner, key) for owner, key in places if type(owner[key]) in (int, float)]
    if not numbers:
        return
    owner, key = numbers[rng.integers(len(numbers))]
    value = owner[key]
    if kind == "nudge":
        owner[key] = _nudged(value, rng) if isinstance(value, float) else value + 1
    elif kind == "sign":
        owner[key] = -value
    elif kind == "wild":
        owner[key] = WILD[rng.integers(len(WILD))]
    else:
        owner[key] = ODD[rng.integers(len(ODD))]


def _nudged(value: float, rng: np.random.Generator) -> float:
    step = 10.0 ** rng.uniform(-17, 1)
    changed = value * (1 + step) if rng.random() < 0.5 else value + step * rng.choice([-1, 1])
    return changed if math.isfinite(changed) else value


def _leaves(part: Any) -> Any:
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in list(items):
        if isinstance(value, (dict, list)):
            yield from _leaves(value)
        else:
            yield part, key


def _lists(part: Any) -> Any:
    for value in part.values() if isinstance(part, dict) else part:
        if isinstance(value, list):
            yield value
        if isinstance(value, (dict, list)):
            yield from _lists(value)


def _grams(part: Any) -> Any:
    for value in part.values() if isinstance(part, dict) else part:
        if isinstance(value, dict) and "Q" in value and "basis" in value:
            yield value
        if isinstance(value, (dict, list)):
            yield from _grams(value)
