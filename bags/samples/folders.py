"""Where the recordings that ship with the package are."""

from importlib.resources import files
from pathlib import Path


def dart(floor: str = "*") -> list[Path]:
    """The 24 bags of a DART car, `rubbery_...`, `control_...`, `tape_...`, `slippery_...`.

    floor: those of one. See the README beside them.
    """
    return sorted((Path(str(files("bags.samples"))) / "dart").glob(f"{floor}_20*"))


def dart_tables() -> Path:
    """Archive (tar, xz) of 17 of the DART car's drives as its makers' thinned CSV files."""
    return Path(str(files("bags.samples"))) / "dart" / "tables.tar.xz"


def f1tenth() -> list[Path]:
    """The 41 bags of a F1TENTH car, trial_01 to trial_41; see the README beside them."""
    return sorted((Path(str(files("bags.samples"))) / "f1tenth").glob("trial_*"))


def kuka() -> list[Path]:
    """Three bags of a KUKA arm's tracked motions, motion_a to motion_c; see the README there."""
    return sorted((Path(str(files("bags.samples"))) / "kuka").glob("motion_*"))


def schunk() -> list[Path]:
    """Six bags of a Schunk robot arm, trial_001 to trial_100; see the README beside them."""
    return sorted((Path(str(files("bags.samples"))) / "schunk").glob("trial_*"))
