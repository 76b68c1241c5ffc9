"""Provably stable models from a robot's recordings, proved funnels, and the monitor of a robot.

`read_bags` gives trials, `identify` a model, `design` a funnel with its proof; `load` and `check`
have a proof decided again, and `Monitor` holds a robot against it. A name is imported when it is
first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bags.designs.documents import load
    from bags.monitoring.replay import replay
    from bags.pictures.notebook import plot, to_control
    from bags.samples.folders import f1tenth
    from bags.signals.grid import read_dataset as read_bags
    from bags.signals.sampling import Grid
    from bags.tools.tables import frame
    from nlsid_core.data.trajectory import Dataset, Trajectory
    from nlsid_core.design import (
        ContinuousTracking,
        Goal,
        OutputTube,
        SampledTracking,
        design,
        integrate_nominal,
        plan_motion,
    )
    from nlsid_core.designs import Design
    from nlsid_core.dynamics import Nominal, VectorField
    from nlsid_core.dynamics.taylor import taylor_field
    from nlsid_core.errors import NlsidError
    from nlsid_core.identification import (
        CellRow,
        Degrees,
        Feedback,
        FilterMapFilter,
        Fit,
        Follower,
        LeastSquares,
        Network,
        Polynomial,
        Rie,
        Rse,
        Sem,
        compare,
        identify,
        standard_errors,
    )
    from nlsid_core.proofs import check
    from nlsid_core.running.monitor import Monitor
    from nlsid_core.running.reading import Status

__all__ = [
    "CellRow",
    "ContinuousTracking",
    "Dataset",
    "Degrees",
    "Design",
    "Feedback",
    "FilterMapFilter",
    "Fit",
    "Follower",
    "Goal",
    "Grid",
    "LeastSquares",
    "Monitor",
    "Network",
    "NlsidError",
    "Nominal",
    "OutputTube",
    "Polynomial",
    "Rie",
    "Rse",
    "SampledTracking",
    "Sem",
    "Status",
    "Trajectory",
    "VectorField",
    "check",
    "compare",
    "design",
    "f1tenth",
    "frame",
    "identify",
    "integrate_nominal",
    "load",
    "plan_motion",
    "plot",
    "read_bags",
    "replay",
    "standard_errors",
    "taylor_field",
    "to_control",
]

_FAMILIES: Final = (
    "Polynomial",
    "Degrees",
    "Network",
    "FilterMapFilter",
    "Follower",
    "CellRow",
    "Feedback",
)
_METHODS: Final = ("LeastSquares", "Rie", "Rse", "Sem")
_PROBLEMS: Final = ("OutputTube", "SampledTracking", "ContinuousTracking", "Goal")
_MOTIONS: Final = ("integrate_nominal", "plan_motion")
_HOMES: Final = {
    "bags.pictures.notebook": ("plot", "to_control"),
    "bags.monitoring.replay": ("replay",),
    "bags.samples.folders": ("f1tenth",),
    "bags.signals.grid": ("read_bags",),
    "bags.signals.sampling": ("Grid",),
    "bags.tools.tables": ("frame",),
    "nlsid_core.data.trajectory": ("Dataset", "Trajectory"),
    "nlsid_core.identification": (
        "identify",
        "Fit",
        "compare",
        "standard_errors",
        *_FAMILIES,
        *_METHODS,
    ),
    "nlsid_core.design": ("design", *_PROBLEMS, *_MOTIONS),
    "nlsid_core.designs": ("Design",),
    "bags.designs.documents": ("load",),
    "nlsid_core.dynamics": ("Nominal", "VectorField"),
    "nlsid_core.dynamics.taylor": ("taylor_field",),
    "nlsid_core.proofs": ("check",),
    "nlsid_core.running.monitor": ("Monitor",),
    "nlsid_core.running.reading": ("Status",),
    "nlsid_core.errors": ("NlsidError",),
}
_CALLED_THERE: Final = {"read_bags": "read_dataset"}
_HOME_OF: Final = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'nlsid' has no attribute '{name}'")
    return getattr(import_module(_HOME_OF[name]), _CALLED_THERE.get(name, name))


def __dir__() -> list[str]:
    return __all__
