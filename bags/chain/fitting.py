"""Whether a configuration fits bags: names of trials, topics, types and stamps, no message read."""

from collections.abc import Sequence
from pathlib import Path

from bags.chain.config import Config, signal_texts
from bags.chain.steps import USES, absent_from, with_parts
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import trial_name
from bags.signals.sampling import Sampler
from nlsid_core.errors import BagError


def misfits(config: Config, bags: Sequence[Path]) -> list[str]:
    """What identification or a monitor would refuse of these bags; the same is said once.

    Raises OSError if a file of definitions cannot be read.
    """
    definitions = read_definitions(config.definitions)
    sampler = Sampler(*signal_texts(config), period=config.grid.period)
    found: dict[str, list[str]] = {}
    for path in bags:
        try:
            with Bag(path, definitions=definitions) as bag:
                said = _misfits(bag, sampler)
        except BagError as error:
            said = [str(error)]
        for what in said:
            found.setdefault(what, []).append(path.name)
    names = set(map(trial_name, bags))
    lines = [f"{_some(where)}: {what}" for what, where in found.items()]
    lines += absent_from(with_parts(sorted(names), config), config)
    for use in USES:
        wanted = getattr(config.split, use)
        if wanted and set(wanted) >= names:
            lines.append(f"split.{use}: names every bag; leave some to train on")
    if not config.split.test and config.split.share is None:
        lines.append("split: nothing to score on; name test bags, or give a share")
    return lines


def _misfits(bag: Bag, sampler: Sampler) -> list[str]:
    said = []
    for topic in sampler.topics:
        try:
            sampler.check(topic, *bag.types_on(topic))
        except BagError as error:
            said.append(str(error).removeprefix(f"{bag.path}: ").replace(str(bag.path), "it"))
    return said


def _some(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
