"""What is fetched of an MCAP file that is not on this machine: the wanted chunks, several together.

A chunk that is wanted is fetched with its message indexes; of an uncompressed one only the indexes
and then the messages, at the places that they name. With an index comes the beginning of the next
chunk: it is a large message that fills a chunk, so small ones often follow it in the next.
"""

from collections.abc import Collection, Sequence
from typing import Final, NamedTuple

import numpy as np

from bags.recordings.batch import Buffer
from bags.recordings.mcap_records import Block, index_offsets
from bags.recordings.remote import GAP_BYTES, RemotePath
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

WINDOW_BYTES: Final = 32 * 2**20  # of wanted chunks that are fetched together
SPAN_BYTES: Final = 256 * 2**20  # of the file, from the first to the last of them
AHEAD_BYTES: Final = 2**10  # of the next chunk: its header, a command and an odometry


class Fetched(NamedTuple):
    """What is wanted of an uncompressed chunk.

    offsets: where each channel's messages begin in it. edges: ascending, where any of them begins,
    and the chunk's end. runs: first bytes and ends of what is fetched.
    """

    offsets: dict[int, IntArray]
    edges: IntArray
    runs: list[tuple[int, int]]


class Fetching:
    """The chunks of a file, of which a window at a time is fetched for some channels."""

    def __init__(self, path: RemotePath, blocks: Sequence[Block]) -> None:
        self._path = path
        self._blocks = blocks
        self._channels: frozenset[int] = frozenset()
        self._ready: dict[int, Fetched | None] = {}  # by the first bytes of the window's chunks

    def hold(self, block: Block, channels: Collection[int]) -> Fetched | None:
        """Fetch what is wanted of this chunk, and of those of a window behind it.

        None for a compressed one, which is fetched whole. Raises BagError for damaged indexes.
        """
        if not self._channels.issuperset(channels) or block.offset not in self._ready:
            self._channels = frozenset(channels)
            window = self._window(block)
            self._path.fetch(self._known_at_once(each) for each in window)
            self._ready = {
                each.offset: None if each.compression else self._planned(each) for each in window
            }
            self._path.fetch(
                (each.offset + start, each.offset + end)
                for each in window
                if (plan := self._ready[each.offset])
                for start, end in plan.runs
            )
        return self._ready[block.offset]

    def content(self, block: Block, plan: Fetched) -> Buffer:
        """The bytes of an uncompressed chunk, zeros where nothing is wanted."""
        content = bytearray(block.size)
        for start, end in plan.runs:
            content[start:end] = self._path.read_range(block.offset + start, block.offset + end)
        return content

    def _window(self, first: Block) -> list[Block]:
        """This chunk, and wanted ones behind it."""
        window: list[Block] = []
        held = 0
        for block in self._blocks[self._blocks.index(first) :]:
            if not block.has(self._channels):
                continue
            held += block.size
            if window and (held > WINDOW_BYTES or block.end - first.offset > SPAN_BYTES):
                break
            window.append(block)
        return window

    def _known_at_once(self, block: Block) -> tuple[int, int]:
        """What is fetched of a chunk before its indexes are read."""
        if block.compression:
            return block.record, block.last
        return block.end, min(block.last + AHEAD_BYTES, self._path.entry.size)

    def _planned(self, block: Block) -> Fetched:
        """What to fetch: runs of wanted messages without a gap of GAP_BYTES between them.

        A message ends where the next one, or the chunk, does.
        """
        listed: dict[int, IntArray] = {}
        for channel, (at, length) in (block.index or {}).items():
            where = f"the message index at byte {at}"
            listed[channel] = index_offsets(self._path.read_range(at, at + length), channel, where)
            if (listed[channel] >= block.size).any():
                raise BagError(f"{where} points outside its chunk")
        edges = np.sort(np.concatenate([*listed.values(), [block.size]]))
        wanted = [offsets for channel, offsets in listed.items() if channel in self._channels]
        first = np.sort(np.concatenate([np.empty(0, np.int64), *wanted]))
        ends = edges[np.searchsorted(edges, first, side="right")]
        gaps = np.flatnonzero(first[1:] > ends[:-1] + GAP_BYTES) + 1
        runs = zip(np.split(first, gaps), np.split(ends, gaps), strict=True)
        return Fetched(listed, edges, [(int(at[0]), int(end[-1])) for at, end in runs if len(at)])
