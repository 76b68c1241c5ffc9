"""Small real recordings that ship with the package."""

from importlib.resources import files
from pathlib import Path

__all__ = ["dart", "f1tenth", "schunk"]


def dart(floor: str = "*") -> list[Path]:
    """The 24 bags of a DART car, `rubbery_...`, `control_...`, `tape_...`, `slippery_...`.

    floor: those of one. See the README beside them.
    """
    folder = Path(str(files("bags.samples"))) / "dart"
    return sorted(folder.glob(f"{floor}_20*"))


def f1tenth() -> list[Path]:
    """The 41 bags of a F1TENTH car, trial_01 to trial_41; see the README beside them."""
    folder = Path(str(files("bags.samples"))) / "f1tenth"
    return sorted(folder.glob("trial_*"))


def schunk() -> list[Path]:
    """Six bags of a Schunk robot arm, trial_001 to trial_100; see the README beside them."""
    folder = Path(str(files("bags.samples"))) / "schunk"
    return sorted(folder.glob("trial_*"))
