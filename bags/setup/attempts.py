"""What identification is proposed: what the one rule of `learn` takes of all that is tried."""

from typing import Any, Final

from bags.chain.identification_config import section_of
from bags.setup.ladder import STAGES, Stages, choose
from bags.setup.proposal import Proposal
from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError, NlsidError
from nlsid_core.identification import Choice
from nlsid_core.identification.choosing import HeldOut
from nlsid_core.progress import Progress

SHOWN: Final = 6  # of what was tried


def tried(train: Dataset, stages: Stages = STAGES, *, progress: Progress) -> Choice | None:
    """Everything that was tried for these trials; None if they are too few to hold some out."""
    try:
        return choose(HeldOut.of(train), stages, progress=progress)
    except DataError:
        return None


def say_model(proposal: Proposal, choice: Choice | None, train: Dataset) -> None:
    """Take what the rule takes, say what else was tried, and what to expect."""
    if choice is None or not choice.found:
        _say_untried(proposal, train)
        return

    known = proposal.content["identification"]
    section: dict[str, Any] = section_of(choice.best.attempt, choice.held_out.data)
    if section["model"] == "state_affine" and "input_range" in known:
        section["input_range"] = known["input_range"]
    proposal.content["identification"] = section
    proposal.choice = choice
    said = "; ".join(f"{row.attempt}: {row.percent:.3g} %" for row in choice.ranked[:SHOWN])
    proposal.why["model"] = (
        f"{len(choice.rows)} were tried on {choice.held_out.on} that were held out, and the "
        f"simplest that is as good as the best is taken: {said}"
    )


def _say_untried(proposal: Proposal, train: Dataset) -> None:
    """What identification does with the first guess, where nothing could be held out."""
    proposal.why["model"] = "a first guess"
    try:
        proposal.config().identification.identify(train)
    except NlsidError as reason:
        wall = (
            f"identification will refuse ({reason}); a response that adds up its command for ever "
            "needs |derivative or |washout behind its path"
        )
    else:
        wall = (
            "no class has a proved model of a part of these trials: the model is a first guess, "
            "and nothing says how well it simulates other data"
        )
    proposal.walls.append(wall)
