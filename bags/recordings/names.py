"""Names that exist, for errors about one that does not."""

import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Final

CLOSE: Final = 0.5  # difflib's similarity from which a name may have been meant
SHOWN: Final = 3
LISTED: Final = 20


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """`; did you mean 'a' or 'b'?` for the candidates nearest to `name`; empty if none is near."""
    known = list(candidates)
    near = (
        [each for each in known if _unpadded(each) == _unpadded(name)]
        or [each for each in known if name.startswith("/") and each.endswith(name)]
        or get_close_matches(name, known, n=SHOWN, cutoff=CLOSE)
    )
    if not near:
        return ""
    return f"; did you mean {' or '.join(repr(found) for found in near)}?"


def _unpadded(name: str) -> str:
    """The name with its numbers as they are written without leading zeros."""
    return re.sub(r"0+(?=\d)", "", name)


def listed(names: Iterable[str]) -> str:
    """The names, or the first of them and how many more there are; `none` if there are none."""
    names = list(names)
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return (", ".join(names[:LISTED]) + more) or "none"
