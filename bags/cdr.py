"""Gather fields from serialised messages with NumPy, without decoding the messages.

In CDR a field's place depends only on the lengths of the strings and sequences before it. One
message is walked to find the places of the wanted fields and of those lengths; every message of the
batch whose lengths are the same is then gathered at once, and the rest likewise from its own first
message. Values are those of a full decoder, bit for bit.

Source: OMG CORBA 3.0 (formal/02-06-51), chapter 15.3, CDR; alignment counts from the byte after the
four-byte encapsulation header.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from bags.batch import Batch
from nlsid_core._types import FloatArray, IntArray
from nlsid_core.errors import BagError

NUMBERS: Final = {
    "bool": "u1",
    "byte": "i1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
ENCAPSULATION: Final = 4
PADDING: Final = 3  # bytes a writer may leave after the last field
MAX_LAYOUTS: Final = 16  # per batch; beyond that lengths vary freely and messages go one by one
MAX_STEPS: Final = 10_000_000  # elements walked in one message; more is a type made to hang readers


class Hop(Protocol):
    """One field on the way to a number, and which element of it: see `bags.signals.Step`."""

    @property
    def field(self) -> str:
        """The field's name."""

    @property
    def index(self) -> int | None:
        """The element, if the field is an array."""

    @property
    def key(self) -> tuple[str, str] | None:
        """(array of strings beside it, the string whose place is the element)."""

    @property
    def length(self) -> int | None:
        """The length the array must have, if that matters."""


Target = Sequence[Hop]


@dataclass(frozen=True)
class Layout:
    """Where the wanted numbers are in a message, and the bytes that make it so.

    leaves: (offset, NumPy kind, is bool) per target. fixed: (offset, length) of the bytes that
    another message must share. end: bytes it must at least have; with `whole`, and 3 at most more
    (padding), because its last field was reached.
    """

    order: str
    leaves: tuple[tuple[int, str, bool], ...]
    fixed: tuple[tuple[int, int], ...]
    end: int
    whole: bool


class Gatherer:
    """Gathers the numbers at `targets` from messages of one type."""

    def __init__(self, msgtype: str, types: Typestore, targets: Sequence[Target]) -> None:
        self.msgtype = msgtype
        self.types = types
        self.targets = targets
        self._static: dict[str, bool] = {}
        self._layout: Layout | None = None
        self._template = b""

    def gather(self, batch: Batch) -> FloatArray:
        """(targets, N) values of the batch's N messages.

        Raises UnreadableMessageError, with the message's place in the batch, if one is damaged.
        """
        values = np.empty((len(self.targets), len(batch)))
        rows = np.arange(len(batch))
        layouts = 0
        while len(rows):
            layout, template = self._layout, self._template
            same = None if layout is None else _matches(layout, template, batch, rows)
            if layout is None or same is None or not same.any():
                first = int(rows[0])
                template = batch.data(first)
                try:
                    layout = self.layout(template)
                except BagError as error:
                    raise UnreadableMessageError(first, error) from error
                self._layout, self._template = layout, template
                layouts += 1
                some = rows[:1] if layouts > MAX_LAYOUTS else rows
                same = np.zeros(len(rows), dtype=bool)
                same[: len(some)] = _matches(layout, template, batch, some)
            self._take(layout, batch, rows[same], values)
            rows = rows[~same]
        return values

    def layout(self, data: bytes) -> Layout:
        """Walk one message; BagError if it is damaged or a target is not in it."""
        return _Walk(self, data).layout()

    def is_static(self, description: FieldDesc) -> bool:
        """Whether every message has this field in the same number of bytes."""
        if description[0] == Nodetype.BASE:
            return description[1][0] in NUMBERS
        if description[0] == Nodetype.SEQUENCE:
            return False
        if description[0] == Nodetype.ARRAY:
            return self.is_static(description[1][0])
        name = str(description[1])
        if name not in self._static:
            self._static[name] = False
            fields = self.types.fielddefs[name][1]
            self._static[name] = all(self.is_static(field) for _, field in fields)
        return self._static[name]

    @staticmethod
    def _take(layout: Layout, batch: Batch, rows: IntArray, values: FloatArray) -> None:
        start = batch.start[rows]
        for column, (offset, kind, is_bool) in zip(values, layout.leaves, strict=True):
            found = _view(batch.buffer, layout.order + kind)[start + offset]
            column[rows] = found != 0 if is_bool else found


class UnreadableMessageError(BagError):
    """A message of a batch cannot be read; `row` is its place in the batch."""

    def __init__(self, row: int, reason: BagError) -> None:
        super().__init__(str(reason))
        self.row = row


def _view(buffer: bytes, kind: str) -> Any:
    """The buffer as numbers starting at every byte."""
    dtype = np.dtype(kind)
    return np.ndarray((max(0, len(buffer) - dtype.itemsize + 1),), dtype, buffer, strides=(1,))


def _matches(layout: Layout, template: bytes, batch: Batch, rows: IntArray) -> Any:
    """Which of the messages `rows` have the layout found in `template`."""
    size = batch.size[rows]
    same = (size >= layout.end) & ((size <= layout.end + PADDING) | (not layout.whole))
    start = batch.start[rows]
    for offset, length in layout.fixed:
        fits = start <= len(batch.buffer) - offset - length
        if not fits.all():
            same &= fits
            start = np.where(fits, start, 0)
        if length == 4:
            words = _view(batch.buffer, "<u4")[start + offset]
            same &= words == int.from_bytes(template[offset : offset + 4], "little")
        else:
            spans = _view(batch.buffer, f"V{length}")[start + offset]
            wanted = np.frombuffer(template[offset : offset + length], "u1")
            same &= (spans.view("u1").reshape(len(rows), length) == wanted).all(axis=1)
    return same


class _Walk:
    """One message, walked from its start as far as its layout matters."""

    def __init__(self, gatherer: Gatherer, data: bytes) -> None:
        if len(data) < ENCAPSULATION or data[0] != 0 or data[1] > 1:
            raise BagError(f"not a '{gatherer.msgtype}': not CDR, starts with {data[:4].hex(' ')}")
        self._of = gatherer
        self._data = data
        self._order = "<" if data[1] else ">"
        self._at = ENCAPSULATION
        self._fixed = [(0, 2)]
        self._leaves: list[tuple[int, str, bool] | None] = [None] * len(gatherer.targets)
        self._missing = len(gatherer.targets)
        self._steps = 0

    def layout(self) -> Layout:
        wanted = [(i, 0) for i in range(len(self._of.targets))]
        whole = self._struct(self._of.msgtype, wanted)
        if whole and len(self._data) > self._at + PADDING:
            raise BagError(
                f"not a '{self._of.msgtype}': the message has {len(self._data)} bytes, "
                f"one with its lengths has {self._at}"
            )
        leaves = tuple(leaf for leaf in self._leaves if leaf is not None)
        assert len(leaves) == len(self._of.targets)
        return Layout(self._order, leaves, _joined(self._fixed), self._at, whole)

    def _struct(self, msgtype: str, wanted: list[tuple[int, int]]) -> bool:
        """Walk a message; False once the rest of it cannot matter."""
        keys: dict[str, list[str]] = {}
        hops = [(i, depth, self._of.targets[i][depth]) for i, depth in wanted]
        key_fields = {hop.key[0] for _, _, hop in hops if hop.key is not None}
        for name, description in self._of.types.fielddefs[msgtype][1]:
            here = [(i, depth, hop) for i, depth, hop in hops if hop.field == name]
            if not self._missing and not self._of.is_static(description):
                return False
            if name in key_fields:
                keys[name] = self._strings(description)
            elif not self._field(description, here, keys):
                return False
        return True

    def _field(
        self,
        description: FieldDesc,
        here: list[tuple[int, int, Hop]],
        keys: dict[str, list[str]],
    ) -> bool:
        if description[0] == Nodetype.NAME:
            return self._struct(str(description[1]), [(i, depth + 1) for i, depth, _ in here])
        if description[0] == Nodetype.BASE:
            self._base(str(description[1][0]), [i for i, _, _ in here])
            return True
        element, length = description[1]
        count = int(str(length)) if description[0] == Nodetype.ARRAY else self._word()
        places: dict[int, list[tuple[int, int]]] = {}
        for i, depth, hop in here:
            try:
                place = self._place(hop, count, keys)
            except BagError as error:
                target = ".".join(map(str, self._of.targets[i]))
                raise BagError(f"{target}: {error}") from error
            places.setdefault(place, []).append((i, depth))
        if element[0] == Nodetype.BASE and element[1][0] in NUMBERS:
            self._numbers(str(element[1][0]), count, places)
            return True
        for k in range(count):
            inside = places.get(k, [])
            if not self._missing and not self._of.is_static(element):
                return False
            if element[0] == Nodetype.NAME:
                deeper = [(i, depth + 1) for i, depth in inside]
                if not self._struct(str(element[1]), deeper):
                    return False
            else:
                self._base(str(element[1][0]), [i for i, _ in inside])
            self._count_step()
        return True

    def _place(self, hop: Hop, count: int, keys: dict[str, list[str]]) -> int:
        if hop.length is not None and count != hop.length:
            raise BagError(
                f"'{hop.field}' has {count} elements, the first message has {hop.length}"
            )
        place = hop.index
        if hop.key is not None:
            beside, wanted = hop.key
            there = keys.get(beside, [])
            if wanted not in there:
                raise BagError(f"'{beside}' has no '{wanted}'; it has: {', '.join(there)}")
            place = there.index(wanted)
        assert place is not None
        if place >= count:
            raise BagError(f"'{hop.field}' has {count} elements")
        return place

    def _base(self, name: str, wanted: list[int]) -> None:
        if name == "string":
            self._string()
            return
        self._numbers(name, 1, {0: [(i, 0) for i in wanted]})

    def _numbers(self, name: str, count: int, places: dict[int, list[tuple[int, int]]]) -> None:
        if name not in NUMBERS:
            raise BagError(f"a '{self._of.msgtype}' holds a {name}, which cannot be read")
        kind = NUMBERS[name]
        size = int(kind[1:])
        if count:
            self._align(size)
        for place, wanted in places.items():
            for i, _ in wanted:
                self._leaves[i] = (self._at + place * size, kind, name == "bool")
                self._missing -= 1
        self._at += count * size
        self._check_end()

    def _word(self) -> int:
        """A string's or sequence's length; it becomes part of the layout."""
        self._align(4)
        self._at += 4
        self._check_end()
        self._fixed.append((self._at - 4, 4))
        order = "little" if self._order == "<" else "big"
        return int.from_bytes(self._data[self._at - 4 : self._at], order)  # type: ignore[arg-type]

    def _string(self) -> bytes:
        length = self._word()
        self._at += length
        self._check_end()
        text = self._data[self._at - length : self._at]
        if not text or text[-1]:
            raise BagError(f"not a '{self._of.msgtype}': a string of {length} bytes has no end")
        return text[:-1]

    def _strings(self, description: FieldDesc) -> list[str]:
        """An array of strings whose content is part of the layout."""
        assert description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        length = description[1][1]
        count = int(str(length)) if description[0] == Nodetype.ARRAY else self._word()
        start = self._at
        found = []
        for _ in range(count):
            found.append(self._string().decode("utf-8", "replace"))
            self._count_step()
        if self._at > start:
            self._fixed.append((start, self._at - start))
        return found

    def _align(self, size: int) -> None:
        self._at += -(self._at - ENCAPSULATION) % size

    def _check_end(self) -> None:
        if self._at > len(self._data):
            raise self._too_short()

    def _too_short(self) -> BagError:
        return BagError(
            f"not a '{self._of.msgtype}': the message has {len(self._data)} bytes, "
            f"one with its lengths has at least {self._at}"
        )

    def _count_step(self) -> None:
        self._steps += 1
        if self._steps > MAX_STEPS:
            raise BagError(f"a '{self._of.msgtype}' of more than {MAX_STEPS} elements")


def _joined(spans: Sequence[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Spans without those that lie inside others."""
    kept: list[tuple[int, int]] = []
    for offset, length in sorted(spans, key=lambda span: (span[0], -span[1])):
        if not kept or offset + length > kept[-1][0] + kept[-1][1]:
            kept.append((offset, length))
    return tuple(kept)
