"""Cases of a test that take long, for `make test` to leave out."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_among(cases: Iterable[Any], names: Collection[Any]) -> list[Any]:
    """The cases, of which those whose name is in `names` are slow.

    A case's name is the case itself; of a tuple it is the first entry, of a function its name.
    """
    return [
        pytest.param(*_values(c), marks=pytest.mark.slow) if _name(c) in names else c for c in cases
    ]


def _values(case: Any) -> tuple[Any, ...]:
    return case if isinstance(case, tuple) else (case,)


def _name(case: Any) -> Any:
    return getattr(_values(case)[0], "__name__", _values(case)[0])
