"""The lags and degrees of a proposed configuration, by the error on trials that are held back."""

import math
from contextlib import suppress
from itertools import product
from typing import Final

import numpy as np

from bags.setup.candidates import Found, Pair, slope_window
from bags.setup.proposal import FITTED, Proposal
from bags.signals.delays import RELATED
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import NlsidError
from nlsid_core.identification import Degrees, LeastSquares, Polynomial, Rse, identify

LAGS: Final = (1, 2, 3, 4, 6, 8, 10)  # tried on a part of the training trials
FEW_LAGS: Final = (1, 2, 3)  # tried with several signals, the inputs at all delays or at one,
DEGREES: Final = (1, 2, 3, 4)  # with these degrees in the inputs
MOST_TERMS: Final = 150  # of a polynomial in the inputs that is tried
TRIED_ITERATIONS: Final = 8  # of the robust simulation error, enough to tell lags apart
LAGS_BETTER: Final = 0.98  # of the error that more lags have to reach
SHOWN: Final = 4  # of the classes that were tried
OTHERS: Final = 3  # commands that are named besides


def say_lags(proposal: Proposal, train: Dataset) -> None:
    """The fewest lags whose simulation of a part of the training trials is about as good as any."""
    names = train.names
    held_back = list(names[1::3]) or list(names[:1])
    alone = len(held_back) == len(names)
    fitted = train if alone else train.without(held_back)
    errors: dict[int, float] = {}
    for lags in LAGS:
        try:
            fit = identify(
                fitted,
                Polynomial(lags),
                method=Rse(iterations=TRIED_ITERATIONS),
                comparators=(),
                test=train.select(held_back),
            )
        except NlsidError:  # too few samples for so many, or no proof
            continue
        errors[lags] = float(fit.errors["test"]["rse"])
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
    if not known:  # a part of the trials is too little for a model, and all of them are not
        alone, held_back = True, list(names)
        known = {lags: float(fit.errors["train"][fit.chosen.method.name])}
    proposal.error = known.get(section["lags"], min(known.values()))
    proposal.varies = _varies(train.select(held_back))
    said = ", ".join(f"{lags}: {error:.3g} %" for lags, error in known.items())
    if alone:
        _say_alone(proposal, train, "lags")
    proposal.why["lags"] = f"proved models simulated on {proposal.tried_on} are off by {said}"


def say_degree(proposal: Proposal, train: Dataset) -> None:
    """Lags, delays and degree in the inputs of a class for several, by trials held back."""
    section = proposal.content["identification"]
    ranges = tuple((float(low), float(high)) for low, high in section["input_range"])
    names = train.names
    held_back = list(names[1::3]) or list(names[:1])
    alone = len(held_back) == len(names)
    fitted = train if alone else train.without(held_back)
    known: dict[Polynomial, float] = {}
    for lags, degree in product(FEW_LAGS, DEGREES):
        for delays in (None, *((k,) for k in range(1, lags + 1))):
            tried = Polynomial(lags, delays, Degrees(inputs=degree), input_range=ranges)
            if _terms(tried) > MOST_TERMS:
                continue
            with suppress(NlsidError):
                fit = identify(
                    fitted,
                    tried,
                    method=LeastSquares(),
                    comparators=(),
                    test=train.select(held_back),
                    allow_unproved=True,
                )
                error = float(fit.errors["test"]["least_squares"])
                if math.isfinite(error):
                    known[tried] = error
    if not known:
        return
    best = min(known.values())
    proposal.varies = _varies(train.select(held_back))
    good = min(
        (c for c, error in known.items() if error * LAGS_BETTER <= best),
        key=lambda c: c.lags + _terms(c),
    )
    proposal.error = known[good]
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
    if alone:
        _say_alone(proposal, train, "lags, delays and degree")
    proposal.why["lags"] = (
        f"least squares on {proposal.tried_on}; lags, delays, right_degree: {said}"
    )
    proposal.why["right_degree"] = "as the lags"


def followed(proposal: Proposal, found: Found) -> list[Pair]:
    """The pairs of the first response with commands that were not chosen and that it follows."""
    signals = proposal.content["signals"]
    chosen = {signal["path"] for signal in signals["excitation"]}
    pairs = found.best_for(signals["response"][0]["path"])
    follows = [p for p in pairs if p.command.text not in chosen and abs(p.correlation) >= RELATED]
    return follows[:OTHERS]


def _say_alone(proposal: Proposal, train: Dataset, what: str) -> None:
    """That no trial judges the choice."""
    proposal.tried_on = FITTED
    why = "one training trial" if len(train) == 1 else "too little in a part of the trials"
    proposal.walls.append(
        f"there is {why}: {what} were chosen by the error on what they were fitted to, which more "
        "lags always lower; with more bags they are chosen on trials that are held back"
    )


def _varies(trials: Dataset) -> str:
    """What a percentage of these trials is of: calmer trials have a larger one."""
    first = trials.trajectories[0]
    if len(first.y_names) != 1:
        return ""
    spread = float(np.std(np.concatenate([trial.y for trial in trials])))
    of = f"{first.y_names[0]} varies by {spread:.3g} {first.y_units[0]}".rstrip()
    return f", in which {of}, rms; of calmer test trials it is more"


def _terms(tried: Polynomial) -> int:
    """Of the polynomial in the inputs."""
    window = len(tried.window(len(tried.input_range or ())))
    return math.comb(window + tried.degrees.inputs, tried.degrees.inputs)
