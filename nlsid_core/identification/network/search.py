"""How networks are found, by their structure: each has a fit, and the proof is one for all."""

from collections.abc import Callable
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import Infeasible
from nlsid_core.identification.fit import History, Step
from nlsid_core.identification.methods.options import Sem
from nlsid_core.identification.network.cells import cells_in_a_row
from nlsid_core.identification.network.feedback import feedback_unrolled
from nlsid_core.identification.network.filters import filter_map_filter
from nlsid_core.identification.network.follower import follower
from nlsid_core.identification.network.options import (
    CellRow,
    Feedback,
    FilterMapFilter,
    Follower,
    Network,
)
from nlsid_core.identification.proofs.stability import StabilityProof, prove_stability
from nlsid_core.identification.trail import Task, Trail

# A structure's fit, and the training errors of its steps.
Fitted = Callable[[Dataset, Network[Any], Task], tuple[Any, tuple[Step, ...]]]
FITS: dict[type, Fitted] = {
    FilterMapFilter: filter_map_filter,
    CellRow: cells_in_a_row,
    Feedback: feedback_unrolled,
    Follower: follower,
}


def search(train: Dataset, model_class: Network[Any], task: Task) -> Trail[Any]:
    """Candidates of the methods that are asked for."""
    fitted = FITS[type(model_class.structure)]
    unit = train.trajectories[0].y_units[0]
    trail: Trail[Any] = Trail(task, prove_stability, f"training error, rms [{unit}]")

    def certified(_: Sem) -> tuple[Any, StabilityProof]:
        model, steps = fitted(train, model_class, task)
        proof = prove_stability(model)
        if proof is None:
            raise Infeasible("no proof for the minimum found; try a smaller max_rate or structure")
        trail.history = History(trail.history.value, steps)
        return model, proof

    trail.add_proved("sem_certified", certified)
    return trail
