"""Classes of models that are not linear, tried where the linear ones say little.

Each is fitted to a part of the training trials and judged by trials held back from it, as the
linear models were; a model without a proof counts for nothing.
"""

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, Final

from pydantic import TypeAdapter

from bags.chain.identification_config import Identification, IdentificationConfig
from bags.setup.proposal import POOR, Proposal
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import NlsidError
from nlsid_core.identification import Sem, identify
from nlsid_core.identification.validation import hold_out

SAMPLES: Final = 2000  # of the training trials, to which these classes are fitted
START: Final = 20  # samples of each trial that are not scored: some classes read their start there
SECONDS: Final = 30.0  # of processor time, after which no further class is begun
ENOUGH: Final = 5.0  # % of error, below which no further class is tried
BETTER: Final = 0.8  # of the linear model's error, that another class has to reach
LOOP_WORTH: Final = 0.6  # of the best error so far, that an unproved loop has to reach
LAGS: Final = (2, 3)  # of such loops

Section = Mapping[str, Any]


def say_class(proposal: Proposal, train: Dataset) -> None:
    """Propose another class where its proved model simulates trials held back far better."""
    if not ENOUGH < proposal.error < math.inf:
        return
    names = train.names[1::3]
    fitted, held_back = (train.without(names), train.select(names)) if names else hold_out(train)
    judges = "trials held back" if names else "the part of the trial held back"
    section = proposal.content["identification"]
    (_, error), *others = tried_classes(section, fitted, held_back)
    if not others:
        return
    best, least = min(others, key=lambda tried: tried[1])
    said = ", ".join(
        f"{s['model']}: " + (f"{e:.3g} %" if e < math.inf else "none is proved")
        for s, e in [(section, error), *others]
    )
    proposal.why["model"] = (
        f"proved models of {SAMPLES} samples or fewer, simulated on {judges} without the first "
        f"{START} samples, are off by {said}"
    )
    # Of so few samples the known class may have no proved model; of all of them it had one.
    if least <= min(BETTER * min(error, proposal.error), POOR):
        proposal.content["identification"] = dict(best)
        proposal.error, proposal.tried_on = least, judges
        for key in ("lags", "delays", "right_degree", "input_range", "method"):
            proposal.why.pop(key, None)


def tried_classes(
    known: Section, train: Dataset, held_back: Dataset
) -> Iterator[tuple[Section, float]]:
    """Sections `identification` of one response with the errors [%] of their proved models.

    The known section comes first; the others do if it is not good enough. All are scored on the
    same samples. Of the others those without a proved model are left out.
    """
    few, started, best = _shortened(train), time.process_time(), math.inf
    for section in (known, *_sections(len(train.trajectories[0].u_names))):
        error = _error(section, few, held_back)
        if math.isfinite(error) or section is known:
            best = min(best, error)
            yield section, error
        if best <= ENOUGH or time.process_time() - started > SECONDS:
            return
    loops = {
        lags: _error(
            {"model": "feedback", "lags": lags, "method": Sem.word, "certified": False},
            few,
            held_back,
        )
        for lags in LAGS
    }
    lags = min(loops, key=loops.__getitem__)
    if loops[lags] < LOOP_WORTH * best:
        section = {"model": "feedback", "lags": lags}
        error = _error(section, few, held_back)
        if math.isfinite(error):
            yield section, error


def _sections(excitations: int) -> Iterator[Section]:
    """The quick ones first."""
    if excitations == 1:
        yield {"model": "block_cascade", "orders": [2, 2], "phases": [1], "intervals": [8, 16]}
    yield {"model": "cells", "cells": 1, "limit": "friction"}
    yield {"model": "cells", "cells": 2, "limit": "top"}


def _error(section: Section, fitted: Dataset, held_back: Dataset) -> float:
    """Of the simulation of the trials held back, in %; infinite without a model to propose."""
    adapter: TypeAdapter[IdentificationConfig] = TypeAdapter(Identification)
    options = adapter.validate_python(dict(section))
    method = options.method
    is_proved = section.get("certified", True)
    with suppress(NlsidError):
        fit = identify(
            fitted,
            options.model_class,
            method=method,
            comparators=(),
            test=held_back,
            transient=START,
            allow_unproved=not is_proved,
        )
        error = float(fit.errors["test"][method.name])
        if math.isfinite(error):
            return error
    return math.inf


def _shortened(train: Dataset) -> Dataset:
    """The first trials that have `SAMPLES` together; the last of them may be a part."""
    kept, left = [], SAMPLES
    for trial in train:
        if left > 0:
            kept.append(trial.rows(slice(left)))
        left -= len(trial)
    return Dataset(tuple(kept))
