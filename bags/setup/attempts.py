"""Models that are tried: lags, degrees and the class of a proposed configuration.

Each is fitted to a part of the training trials and judged by the others. A model of a class that is
not linear counts only if it is proved.
"""

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter

from bags.chain.identification_config import Identification, IdentificationConfig
from bags.setup.candidates import Found, Pair, slope_window
from bags.setup.proposal import FITTED, POOR, Proposal
from bags.signals.delays import RELATED
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import NlsidError
from nlsid_core.identification import (
    Degrees,
    LeastSquares,
    Method,
    ModelClass,
    Polynomial,
    Rse,
    Sem,
    identify,
)
from nlsid_core.identification.validation import hold_out

LAGS: Final = (1, 2, 3, 4, 6, 8, 10)  # tried on a part of the training trials
FEW_LAGS: Final = (1, 2, 3)  # tried with several signals, the inputs at all delays or at one,
DEGREES: Final = (1, 2, 3, 4)  # with these degrees in the inputs
MOST_TERMS: Final = 150  # of a polynomial in the inputs that is tried
TRIED_ITERATIONS: Final = 8  # of the robust simulation error, enough to tell lags apart
LAGS_BETTER: Final = 0.98  # of the error that more lags have to reach
SHOWN: Final = 4  # of the classes that were tried
OTHERS: Final = 3  # commands that are named besides

SAMPLES: Final = 2000  # of the training trials, to which classes that are not linear are fitted
START: Final = 20  # samples of each trial that are not scored: some classes read their start there
SECONDS: Final = 30.0  # of processor time, after which no further class is begun
ENOUGH: Final = 5.0  # % of error, below which no further class is tried
BETTER: Final = 0.8  # of the linear model's error, that another class has to reach
LOOP_WORTH: Final = 0.6  # of the best error so far, that an unproved loop has to reach
LOOP_LAGS: Final = (2, 3)

Section = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Judging:
    """Training trials in two parts: models are fitted to one and judged by the other.

    on: what judges, in words.
    """

    fitted: Dataset
    judged: Dataset
    on: str

    @classmethod
    def of(cls, train: Dataset) -> "Judging":
        """Every third trial judges, or the end of the only one."""
        if names := train.names[1::3]:
            return cls(train.without(names), train.select(names), "trials held back")
        return cls(*hold_out(train), "the part of the trial held back")

    def error(
        self, kind: ModelClass, method: Method, *, transient: int = 0, is_proved: bool = True
    ) -> float:
        """Of the simulation, in %; infinite without a model."""
        with suppress(NlsidError):  # too few samples, or no proof
            fit = identify(
                self.fitted,
                kind,
                method=method,
                comparators=(),
                test=self.judged,
                transient=transient,
                allow_unproved=not is_proved,
            )
            error = float(fit.errors["test"][method.name])
            if math.isfinite(error):
                return error
        return math.inf


def say_lags(proposal: Proposal, train: Dataset) -> None:
    """The fewest lags whose simulation of a part of the training trials is about as good as any."""
    judging, method = Judging.of(train), Rse(iterations=TRIED_ITERATIONS)
    errors = {lags: judging.error(Polynomial(lags), method) for lags in LAGS}
    known = {lags: error for lags, error in errors.items() if math.isfinite(error)}
    best = min(known.values(), default=math.inf)
    section = proposal.content["identification"]
    good = min((lags for lags, error in known.items() if error * LAGS_BETTER <= best), default=0)
    others = sorted(set(LAGS) - {good}, key=lambda lags: (known.get(lags, math.inf), -lags))
    refused: dict[int, str] = {}
    for lags in (good, *others) if known else (section["lags"],):
        try:
            fit = identify(train, Polynomial(lags), comparators=())
        except NlsidError as error:  # more data and iterations may end without a proof: the next
            refused[lags] = str(error)
        else:
            section["lags"] = lags
            break
    else:
        proposal.why["lags"] = "a first guess"
        window = slope_window(1.0 / proposal.content["grid"]["period"])
        proposal.walls.append(
            "no number of lags gave a model that is proved stable: identification will refuse "
            f"({refused[section['lags']]}); a response that adds up its command for ever needs "
            f"|derivative({window:g} s), or |washout(2 s), the time over which its way should be "
            "told"
        )
        return

    judged, proposal.tried_on = judging.judged, judging.on
    if not known:  # a part of the trials is too little for a model, and all of them are not
        judged, proposal.tried_on = train, FITTED
        known = {lags: float(fit.errors["train"][fit.chosen.method.name])}
        proposal.walls.append(
            "a part of the training trials is too little for a model: lags were chosen by the "
            "error on what they were fitted to, which more lags always lower; with more bags they "
            "are chosen on trials that are held back"
        )
    proposal.error = known.get(section["lags"], min(known.values()))
    proposal.varies = _varies(judged)
    said = ", ".join(f"{lags}: {error:.3g} %" for lags, error in known.items())
    proposal.why["lags"] = f"proved models simulated on {proposal.tried_on} are off by {said}"


def say_degree(proposal: Proposal, train: Dataset) -> None:
    """Lags, delays and degree in the inputs of a class for several, by trials held back."""
    section = proposal.content["identification"]
    ranges = tuple((float(low), float(high)) for low, high in section["input_range"])
    judging = Judging.of(train)
    known: dict[Polynomial, float] = {}
    for tried in _affine(ranges):
        error = judging.error(tried, LeastSquares(), is_proved=False)
        if math.isfinite(error):
            known[tried] = error
    if not known:
        return

    best = min(known.values())
    good = min(
        (c for c, error in known.items() if error * LAGS_BETTER <= best),
        key=lambda c: c.lags + _terms(c),
    )
    proposal.error, proposal.tried_on = known[good], judging.on
    proposal.varies = _varies(judging.judged)
    section |= {"lags": good.lags, "right_degree": good.degrees.inputs}
    if good.delays is not None:
        section["delays"] = list(good.delays)
        proposal.why["delays"] = "as the lags"
    ranked = sorted(known, key=known.__getitem__)
    shown = [(c, known[c]) for c in dict.fromkeys([*ranked[:SHOWN], good])]
    said = ", ".join(
        f"{c.lags}, {'all' if c.delays is None else c.delays[0]}, {c.degrees.inputs}: {error:.3g} %"
        for c, error in shown
    )
    proposal.why["lags"] = f"least squares on {judging.on}; lags, delays, right_degree: {said}"
    proposal.why["right_degree"] = "as the lags"


def say_class(proposal: Proposal, train: Dataset) -> None:
    """Propose another class where its proved model simulates trials held back far better."""
    if not ENOUGH < proposal.error < math.inf:
        return
    judging = Judging.of(train)
    judging = replace(judging, fitted=_shortened(judging.fitted))
    section = proposal.content["identification"]
    (_, error), *others = tried_classes(
        section, len(proposal.content["signals"]["excitation"]), judging
    )
    if not others:
        return
    best, least = min(others, key=lambda tried: tried[1])
    said = ", ".join(
        f"{s['model']}: " + (f"{e:.3g} %" if e < math.inf else "none is proved")
        for s, e in [(section, error), *others]
    )
    proposal.why["model"] = (
        f"proved models of {SAMPLES} samples or fewer, simulated on {judging.on} without the first "
        f"{START} samples, are off by {said}"
    )
    # Of so few samples the known class may have no proved model; of all of them it had one.
    if least <= min(BETTER * min(error, proposal.error), POOR):
        proposal.content["identification"] = dict(best)
        proposal.error, proposal.tried_on = least, judging.on
        for key in ("lags", "delays", "right_degree", "input_range", "method"):
            proposal.why.pop(key, None)


def tried_classes(
    known: Section, excitations: int, judging: Judging
) -> Iterator[tuple[Section, float]]:
    """Sections `identification` of one response with the errors [%] of their proved models.

    The known section comes first; the others do if it is not good enough, the quick ones first. All
    are scored on the same samples. Of the others those without a proved model are left out.
    """
    sections: list[Section] = [
        known,
        {"model": "block_cascade", "orders": [2, 2], "phases": [1], "intervals": [8, 16]},
        {"model": "cells", "cells": 1, "limit": "friction"},
        {"model": "cells", "cells": 2, "limit": "top"},
    ]
    started, best = time.process_time(), math.inf
    for section in sections if excitations == 1 else (known, *sections[2:]):
        error = _error(section, judging)
        if math.isfinite(error) or section is known:
            best = min(best, error)
            yield section, error
        if best <= ENOUGH or time.process_time() - started > SECONDS:
            return

    unproved = {"model": "feedback", "method": Sem.word, "certified": False}
    loops = {lags: _error({**unproved, "lags": lags}, judging) for lags in LOOP_LAGS}
    lags = min(loops, key=loops.__getitem__)
    if loops[lags] < LOOP_WORTH * best:
        section = {"model": "feedback", "lags": lags}
        error = _error(section, judging)
        if math.isfinite(error):
            yield section, error


def followed(proposal: Proposal, found: Found) -> list[Pair]:
    """The pairs of the first response with commands that were not chosen and that it follows."""
    signals = proposal.content["signals"]
    chosen = {signal["path"] for signal in signals["excitation"]}
    pairs = found.best_for(signals["response"][0]["path"])
    follows = [p for p in pairs if p.command.text not in chosen and abs(p.correlation) >= RELATED]
    return follows[:OTHERS]


def _affine(ranges: tuple[tuple[float, float], ...]) -> Iterator[Polynomial]:
    """Models linear in the outputs and polynomial in inputs of these ranges."""
    for lags, degree in product(FEW_LAGS, DEGREES):
        for delays in (None, *((k,) for k in range(1, lags + 1))):
            tried = Polynomial(lags, delays, Degrees(inputs=degree), input_range=ranges)
            if _terms(tried) <= MOST_TERMS:
                yield tried


def _terms(tried: Polynomial) -> int:
    """Of the polynomial in the inputs."""
    window = len(tried.window(len(tried.input_range or ())))
    return math.comb(window + tried.degrees.inputs, tried.degrees.inputs)


def _error(section: Section, judging: Judging) -> float:
    """Of the model that the section asks for, in %."""
    adapter: TypeAdapter[IdentificationConfig] = TypeAdapter(Identification)
    options = adapter.validate_python(dict(section))
    return judging.error(
        options.model_class,
        options.method,
        transient=START,
        is_proved=section.get("certified", True),
    )


def _shortened(train: Dataset) -> Dataset:
    """The first trials that have `SAMPLES` together; the last of them may be a part."""
    kept, left = [], SAMPLES
    for trial in train:
        if left > 0:
            kept.append(trial.rows(slice(left)))
        left -= len(trial)
    return Dataset(tuple(kept))


def _varies(trials: Dataset) -> str:
    """What a percentage of these trials is of: calmer trials have a larger one."""
    first = trials.trajectories[0]
    if len(first.y_names) != 1:
        return ""
    spread = float(np.std(np.concatenate([trial.y for trial in trials])))
    of = f"{first.y_names[0]} varies by {spread:.3g} {first.y_units[0]}".rstrip()
    return f", in which {of}, rms; of calmer test trials it is more"
