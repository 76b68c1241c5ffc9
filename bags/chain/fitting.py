"""Whether a configuration fits bags: names of trials, topics, types and stamps, no message read."""

from collections.abc import Sequence
from pathlib import Path

from bags.chain.config import Config, signal_texts
from bags.chain.steps import check_split
from bags.recordings.bag import Bag
from bags.recordings.definitions import read_definitions
from bags.recordings.folders import trial_name
from bags.signals.sampling import Sampler
from nlsid_core.errors import BagError, DataError


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
    lines = [f"{_some(where)}: {what}" for what, where in found.items()]
    try:
        check_split(sorted({trial_name(bag) for bag in bags}), config)
    except DataError as error:
        lines.append(str(error))
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
