"""What a checker may say: a `Verdict`, which exists only for claims that are proved."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Decision:
    """What one kind of claim comes to: the statement proved, how far from failing, and on what."""

    statement: str
    margin: float
    assumptions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """A proved claim. Anything else is an exception, so a failed proof cannot be ignored.

    statement: the claim in words, made by the checker from the numbers it checked. margin:
    positive, dimensionless, its meaning stated per claim in docs/certificate.md. assumptions: what
    the claim rests on and a monitor has to watch. mode: how it was decided. digests: the
    files the claim is about. seconds: wall-clock time of the check.
    """

    statement: str
    margin: float
    assumptions: tuple[str, ...]
    mode: str
    digests: dict[str, str]
    seconds: float

    def __str__(self) -> str:
        how = f"in {self.seconds:.3f} s ({self.mode})"
        return f"PROVED {self.statement} margin {self.margin:.3g} {how}"
