"""Changes of documents by place: `funnel.json tubes 0 level` names a member of a list's entry.

`*` is every member of an object or every entry of a list. A change keeps no part of another
document, so that one table of changes serves many tests.
"""

import copy
from collections.abc import Callable, Iterator
from typing import Any

Edit = Callable[[Any], None]


def _owners(document: Any, place: list[str]) -> Iterator[tuple[Any, Any]]:
    """What holds each value at a place, and under which key."""
    name, *rest = place
    keys = [int(name) if isinstance(document, list) and name != "*" else name]
    if name == "*":
        keys = list(document) if isinstance(document, dict) else [*range(len(document))]
    for key in keys:
        if rest:
            yield from _owners(document[key], rest)
        else:
            yield document, key


def changed(place: str, change: Callable[[Any], Any]) -> Edit:
    """Puts what `change` returns of it in the place of each value."""

    def edit(document: Any) -> None:
        for owner, key in list(_owners(document, place.split())):
            owner[key] = change(owner[key])

    return edit


def put(place: str, value: Any) -> Edit:
    """Puts a value there; a member that was not there is new."""

    def edit(document: Any) -> None:
        for owner, key in _owners(document, place.split()):
            owner[key] = copy.deepcopy(value)

    return edit


def scaled(place: str, factor: float) -> Edit:
    """Multiplies a number, or all numbers of nested lists."""
    return changed(place, lambda value: _times(value, factor))


def _times(value: Any, factor: float) -> Any:
    return [_times(v, factor) for v in value] if isinstance(value, list) else value * factor


def without(place: str) -> Edit:
    """Takes a member or an entry out."""

    def edit(document: Any) -> None:
        for owner, key in list(_owners(document, place.split())):
            del owner[key]

    return edit


def exchanged(one: str, other: str) -> Edit:
    """Exchanges two values."""

    def edit(document: Any) -> None:
        ((a, i),), ((b, j),) = (list(_owners(document, place.split())) for place in (one, other))
        a[i], b[j] = b[j], a[i]

    return edit


def both(*edits: Edit) -> Edit:
    """One change after the other."""

    def edit(document: Any) -> None:
        for each in edits:
            each(document)

    return edit
