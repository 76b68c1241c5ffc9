"""What is fetched of an MCAP file that is not on this machine: the wanted chunks, several together.

A chunk that is wanted is fetched with its message indexes; of an uncompressed one only the indexes
and then the messages, at the places that they name. With an index comes the beginning of the next
chunk, as far as the last chunk begins with wanted messages: it is a large message that fills a
chunk, so small ones often follow it in the next.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import groupby
from typing import Final

import numpy as np

from bags.recordings.batch import Buffer
from bags.recordings.mcap_records import Block, index_offsets
from bags.recordings.remote import GAP_BYTES, RemotePath
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

WINDOW_BYTES: Final = 32 * 2**20  # of wanted chunks that are fetched together
SPAN_BYTES: Final = 256 * 2**20  # of the file, from the first to the last of them
AHEAD: Final = 1.5  # of what the last chunk begins with; the next may begin with more


class Fetching:
    """The chunks of a file that were fetched for some channels, a window of them at a time."""

    def __init__(self, path: RemotePath, blocks: Sequence[Block]) -> None:
        self._path = path
        self._blocks = blocks
        self._place = {block.offset: i for i, block in enumerate(blocks)}
        self._channels: frozenset[int] = frozenset()
        self._ready: dict[int, dict[int, IntArray]] = {}  # byte of a chunk -> its message indexes

    def groups(self, channels: Collection[int]) -> Iterator[Sequence[Block]]:
        """The wanted chunks, in the order of the file: those of a window that are not compressed
        together, a compressed one alone.
        """
        wanted = [block for block in self._blocks if block.has(channels)]
        while wanted:
            self.hold(wanted[0], channels)
            window = [block for block in wanted if block.offset in self._ready]
            wanted = wanted[len(window) :]
            for compressed, run in groupby(window, key=lambda block: bool(block.compression)):
                blocks = list(run)
                yield from ([block] for block in blocks) if compressed else [blocks]

    def hold(self, block: Block, channels: Collection[int]) -> None:
        """Fetch what is wanted of this chunk, and of those of a window behind it."""
        if not self._channels.issuperset(channels):
            self._channels, self._ready = frozenset(channels), {}
        if block.offset in self._ready:
            return
        window = self._window(block)
        ahead = self._ahead()
        self._path.fetch(self._span(block, ahead) for block in window)
        self._ready = {block.offset: self._entries_of(block) for block in window}
        starts, ends = self._runs_of([block for block in window if not block.compression])
        self._path.fetch(zip(starts.tolist(), ends.tolist(), strict=True))

    def messages(self, blocks: Sequence[Block]) -> tuple[Buffer, dict[int, IntArray], IntArray]:
        """The bytes of uncompressed chunks that are held, zeros where nothing is wanted; where in
        them each wanted channel's messages begin; and where any of them ends at the latest.
        """
        base = blocks[0].offset
        content = bytearray(blocks[-1].end - base)
        starts, ends = self._runs_of(blocks)
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            content[start - base : end - base] = self._path.read_range(start, end)
        places: dict[int, list[IntArray]] = {}
        edges = [np.array([block.end - base for block in blocks], np.int64)]
        for block in blocks:
            for channel, listed in self._ready[block.offset].items():
                places.setdefault(channel, []).append(block.offset - base + listed)
        offsets = {channel: np.concatenate(found) for channel, found in places.items()}
        return content, offsets, np.sort(np.concatenate([*offsets.values(), *edges]))

    def _window(self, first: Block) -> list[Block]:
        """This chunk, and wanted ones behind it."""
        window: list[Block] = []
        held = 0
        for block in self._blocks[self._place[first.offset] :]:
            if not block.has(self._channels):
                continue
            held += block.size
            if window and (held > WINDOW_BYTES or block.end - first.offset > SPAN_BYTES):
                break
            window.append(block)
        return window

    def _ahead(self) -> int:
        """Bytes of wanted messages with which a chunk may begin: less than a request costs, and 0
        if the index of the last chunk, which tells, would have to be fetched for it.
        """
        last = self._blocks[-1]
        if last.compression or self._path.held(last.end, last.last) is None:
            return 0
        self._ready = {last.offset: self._entries_of(last)}
        _, ends = self._runs_of([last])
        reach = AHEAD * (ends[0] - last.record) if len(ends) else 0.0
        return int(reach) if reach <= GAP_BYTES else 0

    def _span(self, block: Block, ahead: int) -> tuple[int, int]:
        """What is fetched of a block before its indexes are known; with so much of the next."""
        if block.compression:
            return block.record, block.last
        following = self._blocks[self._place[block.offset] + 1 :][:1]
        if not following or not following[0].has(self._channels):
            return block.end, block.last
        return block.end, min(block.last + ahead, following[0].end)

    def _runs_of(self, blocks: Sequence[Block]) -> tuple[IntArray, IntArray]:
        """First bytes and ends, in the file, of runs of wanted messages without a gap of GAP_BYTES.

        A message ends where the next one, or the chunk, does.
        """
        edges: list[IntArray] = [np.array([block.end for block in blocks], np.int64)]
        wanted: list[IntArray] = [np.empty(0, np.int64)]
        for block in blocks:
            for channel, offsets in self._ready[block.offset].items():
                (wanted if channel in self._channels else edges).append(block.offset + offsets)
        first = np.sort(np.concatenate(wanted))
        if not len(first):
            return first, first
        starts = np.sort(np.concatenate([first, *edges]))
        ends = starts[np.searchsorted(starts, first, side="right")]
        gaps = np.flatnonzero(first[1:] > ends[:-1] + GAP_BYTES)
        return first[np.r_[0, gaps + 1]], ends[np.r_[gaps, -1]]

    def _entries_of(self, block: Block) -> dict[int, IntArray]:
        """Offsets of each channel's messages in an uncompressed chunk, as its index records say."""
        found: dict[int, IntArray] = {}
        for channel, (at, length) in (block.index or {}).items() if not block.compression else ():
            where = f"the message index at byte {at}"
            listed = index_offsets(self._path.read_range(at, at + length), channel, where)
            if len(listed) and listed.max() >= block.size:
                raise BagError(f"{where} points outside its chunk")
            found[channel] = listed
        return found
