"""How networks are found, by their structure."""

from dataclasses import replace
from typing import Any

from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification.fit import History, Proof, Step
from nlsid_core.identification.methods.options import Sem
from nlsid_core.identification.network.cascade import identify_block_cascade
from nlsid_core.identification.network.cascade_fit import MAX_RADIUS
from nlsid_core.identification.network.cells import identify_cells
from nlsid_core.identification.network.feedback import identify_feedback, identify_unproved
from nlsid_core.identification.network.options import CellRow, Feedback, FilterMapFilter, Network
from nlsid_core.identification.proofs.stability import prove_stability
from nlsid_core.identification.trail import Task, Trail
from nlsid_core.identification.validation import hold_out

Found = tuple[Any, Proof, tuple[Step, ...]]  # a model, its proof, and the steps of the search


def search(train: Dataset, model_class: Network[Any], task: Task) -> Trail[Any]:
    """Candidates of the methods that are asked for."""
    structure, unit = model_class.structure, train.trajectories[0].y_units[0]
    error = {FilterMapFilter: "validation", CellRow: "training", Feedback: "held-back"}
    trail: Trail[Any] = Trail(
        task, prove_stability, f"{error[type(structure)]} error, rms [{unit}]"
    )

    def certified(method: Sem) -> tuple[Any, Proof]:
        model, proof, steps = _certified(train, model_class, task, method)
        trail.history = History(trail.history.value, steps)
        return model, proof

    trail.add("sem", lambda _: identify_unproved(train, model_class, transient=task.transient))
    trail.add_proved("sem_certified", certified)
    return trail


def _certified(train: Dataset, model_class: Network[Any], task: Task, method: Sem) -> Found:
    """The proved model of a structure."""
    if isinstance(model_class.structure, FilterMapFilter):
        return _filter_map_filter(train, model_class, task)
    if isinstance(model_class.structure, CellRow):
        return identify_cells(
            train,
            model_class,
            transient=task.transient,
            slowest=task.searched_rate,
            steps=method.iterations,
        )
    fitted, judged = hold_out(train)
    return identify_feedback(
        train,
        fitted,
        judged,
        model_class,
        transient=task.transient,
        slowest=min(MAX_RADIUS, task.searched_rate),
        steps=method.iterations,
        progress=task.progress,
    )


def _filter_map_filter(train: Dataset, model_class: Network[FilterMapFilter], task: Task) -> Found:
    fitted, judged = (train, task.validation) if task.validation else hold_out(train)
    model, proof, steps = identify_block_cascade(
        fitted,
        judged,
        model_class,
        whole=train if task.validation is None else None,
        transient=task.transient,
        slowest=min(MAX_RADIUS, task.searched_rate),
        progress=task.progress,
    )
    return replace(model, bags=train.bags), proof, steps
