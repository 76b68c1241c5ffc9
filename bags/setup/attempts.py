"""What identification is proposed: what the one rule of `learn` takes of all that is tried."""

import math
from typing import Any, Final

from bags.chain.identification_config import section_of
from bags.setup.proposal import Proposal
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification import Choice
from nlsid_core.identification.choosing import HeldOut
from nlsid_core.identification.learning import STAGES, Stages, choose
from nlsid_core.progress import Progress

SHOWN: Final = 6  # of what was tried


def tried(train: Dataset, stages: Stages = STAGES, *, progress: Progress) -> Choice | None:
    """Everything that was tried for these trials; None if they are too few to hold some out."""
    try:
        return choose(HeldOut.of(train), stages, progress=progress)
    except DataError:
        return None


def say_model(proposal: Proposal, choice: Choice | None) -> None:
    """Take what the rule takes, say what else was tried, and what to expect."""
    try:
        best = None if choice is None else choice.best
    except Infeasible:
        best = None
    if choice is None or best is None:
        proposal.why["model"] = "a first guess"
        proposal.walls.append(
            "no class that was tried has a proved model of these trials: identification will "
            "refuse; a response that adds up its command for ever needs |derivative or |washout"
            if choice is not None
            else "the trials are too short to hold a part of them out: nothing was tried"
        )
        return

    kept = {key: proposal.content["identification"].get(key) for key in ("input_range",)}
    section: dict[str, Any] = section_of(best.attempt, choice.held_out.data)
    if section["model"] == "state_affine":
        section |= {key: value for key, value in kept.items() if value is not None}
    proposal.content["identification"] = section
    proposal.promise = choice.promise
    shown = [row for row in choice.ranked if math.isfinite(row.percent)][:SHOWN]
    said = "; ".join(f"{row.attempt}: {row.percent:.3g} %" for row in shown)
    proposal.why["model"] = (
        f"{len(choice.rows)} were tried on {choice.held_out.on} that were held out, and the "
        f"simplest that is as good as the best is taken: {said}"
    )
