"""What a claim's `decide` returns."""

from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class Decision:
    """A sentence that was decided, its margin, what it assumes, and the digests of its files."""

    statement: str
    margin: Fraction
    assumptions: tuple[str, ...]
    digests: dict[str, str]
