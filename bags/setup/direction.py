"""Which of two signals leads: a command does, and what is measured follows it."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from bags.setup.candidates import LONGEST_DELAY, Found
from bags.setup.proposal import Proposal
from bags.signals.expressions import factors
from bags.signals.timing import Delay, delay
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError

# Of the correlation one way over that the other way. Measured: right pairs of the shipped robots
# and of three others have 0.941 to 1.008, the same pairs swapped 1.006 to 1.24.
LEADS: Final = 1.005
MOST: Final = 0.75  # of the trials agree
ROLES_APART: Final = 0.3  # in the share by which type and names say that a number drives


def say_direction(proposal: Proposal, found: Found, trials: Dataset) -> None:
    """Ask about an excitation that seems to follow a response, or is named as one would be."""
    signals = proposal.content["signals"]
    shares = {each.text: each.command for each in found.candidates}
    for i, response in enumerate(signals["response"]):
        for j, excitation in enumerate(signals["excitation"]):
            y, u = response["path"], excitation["path"]
            if len(factors(u)) > 1:  # a person made it, of what is measured too
                continue
            is_named_so = shares.get(u, 0.5) + ROLES_APART <= shares.get(y, 0.5)
            lead = lead_of_response(trials, i, j)
            if not (is_named_so or lead):
                continue
            why = [f"{u} follows {y} by {lead:.3g} s"] if lead else []
            why += [f"by type and name {y} drives and {u} is measured"] if is_named_so else []
            proposal.doubts.append(
                f"{u} is taken as what drives and {y} as what answers; are they swapped? "
                f"{', and '.join(why)}: a command leads (-u), what is measured follows it (-y)"
            )


def lead_of_response(trials: Dataset, response: int, excitation: int) -> float:
    """Seconds by which the response leads the excitation; 0 if it does not.

    It does where, in most of the trials, the excitation correlates more with the past of the
    response than the response with the past of the excitation.
    """
    pairs = [
        pair
        for trial in trials
        for pair in _both(trial.y[:, response], trial.u[:, excitation], trial.period)
    ]
    if not pairs:
        return 0.0

    forward, backward = np.abs([[f.correlation, b.correlation] for f, b in pairs]).T
    late = float(np.median([back.seconds for _, back in pairs]))
    agrees = float(np.mean(backward > forward)) >= MOST
    leads = agrees and backward.mean() > LEADS * forward.mean()
    return late if leads and late >= trials.trajectories[0].period else 0.0


def _both(y: FloatArray, u: FloatArray, period: float) -> Iterator[tuple[Delay, Delay]]:
    """How the response follows the excitation, and the reverse; nothing where one is constant."""
    most = min(LONGEST_DELAY, len(y) * period / 4.0)
    try:
        yield delay(u, y, period, most), delay(y, u, period, most)
    except DataError:
        return
