"""Every error the project raises on purpose.

All inherit from `NlsidError` and from the builtin that fits, so a caller can catch either.
"""


class NlsidError(Exception):
    """Base of every error raised on purpose by nlsid."""


class ShapeError(NlsidError, ValueError):
    """An array has the wrong shape; the message states the expected and the given one."""


class DataError(NlsidError, ValueError):
    """Data that cannot be used as given: NaN, unsorted time, a gap, no excitation."""


class OptionError(DataError):
    """An option that is not allowed; the message states its name, its value, what is allowed."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(key, value, allowed)
        self.key, self.value, self.allowed = key, value, allowed

    def __str__(self) -> str:
        return f"{self.key} is {self.value!r}; it should be {self.allowed}"


class BagError(DataError):
    """A bag that cannot be read as asked: damaged, or a missing topic, field or type."""


class DocumentError(DataError):
    """A JSON document (model, policy, funnel, proof) that is not what its format says."""


class NotPolynomial(NlsidError, TypeError):  # noqa: N818 - says what it is
    """An operation whose result is not a polynomial; the message names it."""


class SolverError(NlsidError, RuntimeError):
    """A numerical solver gave up; the message says at what and how far it got."""


class Infeasible(SolverError):  # noqa: N818 - a result of the field, named as the field names it
    """No certificate exists in the class that was searched; the message says what to try."""


class CertificateRejected(NlsidError):  # noqa: N818 - a verdict, not a fault
    """A proof does not prove its claim; reason: one of kernel.REASONS, if the kernel says so."""

    reason = ""


class CertificateMismatch(CertificateRejected):
    """A proof is about another model, policy or funnel than the files beside it."""


def apart(*numbers: float) -> tuple[str, ...]:
    """The numbers as text with so many digits that different ones read differently, at least 6."""
    for digits in range(6, 16):
        texts = tuple(f"{number:.{digits}g}" for number in numbers)
        if len(set(texts)) == len(set(numbers)):
            return texts
    return tuple(repr(float(number)) for number in numbers)


def percent(error: float) -> str:
    """A model's error in %, as text; from 1000 % on the model diverges and digits say nothing."""
    return f"{error:.2f} %" if error < 1000.0 else "diverges"


def counted(count: int, what: str) -> str:
    """A count with its noun, as text: 1 trial, 3 trials."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def duration(seconds: float) -> str:
    """A time of processing, in ms below a second."""
    return f"{seconds * 1e3:.0f} ms" if seconds < 1.0 else f"{seconds:.1f} s"
