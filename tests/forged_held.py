"""Files of a held funnel with one thing made better than it is, and why a checker refuses them."""

from collections.abc import Callable

from tests.funnel_files import POLICY, PROOF, Files, copy_of


def _longer(files: Files) -> None:
    files[PROOF]["claim"]["hold"] *= 1.5


def _measured_worse(files: Files) -> None:
    claim = files[PROOF]["claim"]
    claim["error"] = [5 * e for e in claim["error"]]


def _slower(files: Files) -> None:
    files[PROOF]["proof"]["rates"][3][0] *= 0.5


def _fewer(files: Files) -> None:
    del files[PROOF]["proof"]["rate_pieces"][7]


def _one_way(files: Files) -> None:
    for piece in files[PROOF]["proof"]["rate_pieces"]:
        piece["sign"] = 1


def _still(files: Files) -> None:
    files[PROOF]["proof"]["rates"][0][0] = 0.0


def _jumping(files: Files) -> None:
    files[POLICY]["K"][4][0][0][0] *= 1.001


def _bare(files: Files) -> None:
    del files[PROOF]["claim"]["hold"]


HELD_FORGERIES: dict[str, tuple[Callable[[Files], None], str]] = {
    "a longer hold": (_longer, "not_positive"),
    "a state that is measured worse": (_measured_worse, "not_positive"),
    "an input that turns more slowly": (_slower, "not_positive"),
    "a rate piece less": (_fewer, "not_covered"),
    "rates of one sign": (_one_way, "not_covered"),
    "a rate of 0": (_still, "not_below"),
    "gains that jump at a knot": (_jumping, "not_valid"),
    "rates and no hold": (_bare, "malformed"),
}


def forged_held(files: Files, what: str) -> Files:
    """The documents with one of HELD_FORGERIES; digests as they were."""
    changed = copy_of(files)
    HELD_FORGERIES[what][0](changed)
    return changed
