"""Gather fields from serialised messages with NumPy, without decoding the messages.

In CDR a field's place depends only on the lengths of the strings and sequences before it. One
message is walked to find the places of the wanted fields and of those lengths; every message of the
batch whose lengths are the same is then gathered at once, and the rest likewise from its own first
message. Values are those of a full decoder, bit for bit.

Source: OMG CORBA 3.0 (formal/02-06-51), chapter 15.3, CDR; alignment counts from the byte after the
four-byte encapsulation header.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import repeat
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc
from rosbags.typesys.store import Typestore

from bags.recordings.batch import Batch, Buffer
from nlsid_core.arrays import IntArray
from nlsid_core.errors import BagError

NUMBERS: Final = {
    "bool": "u1",
    "byte": "u1",
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


@dataclass(frozen=True)
class Step:
    """One field on the way to the number, and which element of it if it is an array.

    index: the element. key: (array of strings beside the field, the string at the element's place).
    every: `[*]`, all elements. length: how many elements there must be (None: any number).
    """

    field: str
    index: int | None = None
    key: tuple[str, str] | None = None
    every: bool = False
    length: int | None = None

    def __str__(self) -> str:
        if self.index is not None:
            return f"{self.field}[{self.index}]"
        if self.key is not None:
            return f"{self.field}[{self.key[0]}={self.key[1]}]"
        return f"{self.field}[*]" if self.every else self.field

    @property
    def picks(self) -> bool:
        """Whether it names an element."""
        return self.index is not None or self.key is not None or self.every


Target = Sequence[Step]
STAMP: Final = (
    (Step("header"), Step("stamp"), Step("sec")),
    (Step("header"), Step("stamp"), Step("nanosec")),
)
Numbers = NDArray[Any]  # (N,) of any type of number


class Kind(NamedTuple):
    """What a target is: a number of NumPy's type `of`, or an array of `length` of them."""

    of: str
    is_bool: bool
    length: int | None = None


class Group(NamedTuple):
    """Wanted numbers of one kind: which targets they are, and where they are in a message."""

    kind: Kind
    targets: IntArray
    offsets: IntArray


class Layout(NamedTuple):
    """Where the wanted numbers are in a message, and the bytes that make it so.

    words: (W,) offsets of the lengths that another message must share, expected: (W,) what they
    are. spans: other bytes it must share, (offset, bytes). end: bytes it must at least have; with
    `whole`, and PADDING at most more, because its last field was reached. texts: targets that are
    texts, which are among these bytes, and so the same in all.
    """

    groups: tuple[Group, ...]
    texts: tuple[tuple[int, object], ...]
    words: IntArray
    expected: Any
    spans: tuple[tuple[int, bytes], ...]
    end: int
    whole: bool


@lru_cache(maxsize=256)
def _met(
    msgtype: str,  # noqa: ARG001 - what it is kept for
    types: Typestore,  # noqa: ARG001
    targets: tuple[Target, ...],  # noqa: ARG001
) -> list[Layout]:
    """The layout that was met last for these targets, if any: bags of a fleet have the same.

    Threads share it: take a copy, and replace what is in it at once.
    """
    return []


class Gatherer:
    """Gathers the numbers at `targets` from messages of one type."""

    def __init__(self, msgtype: str, types: Typestore, targets: Sequence[Target]) -> None:
        self.msgtype = msgtype
        self.types = types
        self.targets = targets
        self._static: dict[str, bool] = {}
        self._met = _met(msgtype, types, tuple(targets))

    def gather(self, batch: Batch) -> list[Numbers]:
        """For each target its N numbers, of the type that they have in the batch's N messages.

        Raises UnreadableMessageError, with the message's place in the batch, if one is damaged.
        """
        for row, reason in batch.unreadable.items():
            raise UnreadableMessageError(row, BagError(reason))
        for layout in self._met[:]:
            if _matches(layout, batch).all():
                return _taken(layout, batch)
        values: list[Numbers] = []
        rows = np.arange(len(batch) if self.targets else 0)
        layouts = 0
        while len(rows):
            first = int(rows[0])
            try:
                layout = self.layout(batch.data(first))
            except BagError as error:
                raise UnreadableMessageError(first, error) from error
            self._met[:] = [layout]
            layouts += 1
            some = batch.select(rows if layouts <= MAX_LAYOUTS else rows[:1])
            same = np.zeros(len(rows), dtype=bool)
            same[: len(some)] = _matches(layout, some)
            found = _taken(layout, batch.select(rows[same]))
            values = values or [np.empty(len(batch), column.dtype) for column in found]
            for column, part in zip(values, found, strict=True):
                column[rows[same]] = part
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


class UnreadableMessageError(BagError):
    """A message of a batch cannot be read; `row` is its place in the batch."""

    def __init__(self, row: int, reason: BagError) -> None:
        super().__init__(str(reason))
        self.row = row


def _taken(layout: Layout, batch: Batch) -> list[Numbers]:
    """What is wanted of messages of this layout, in the order of the targets."""
    n = len(batch)
    columns: dict[int, Numbers] = {}
    for (of, is_bool, length), targets, offsets in layout.groups:
        shape = () if length is None else (length,)
        found = _view(batch.buffer, of, shape)[offsets[:, None] + batch.start]
        found = found != 0 if is_bool else found.astype(found.dtype.newbyteorder("="), copy=False)
        for target, column in zip(targets.tolist(), found, strict=True):
            columns[target] = column if length is None else np.fromiter(column, object, n)
    columns |= {target: np.fromiter(repeat(text, n), object, n) for target, text in layout.texts}
    return [columns[target] for target in range(len(columns))]


def _matches(layout: Layout, batch: Batch) -> Any:
    """Which messages of the batch have this layout."""
    size = batch.size
    same = size >= layout.end
    if layout.whole:
        same &= size <= layout.end + PADDING
    if not same.all():
        if same.any():
            rows = np.flatnonzero(same)
            same[rows] = _matches(layout, batch.select(rows))
        return same
    words = _view(batch.buffer, "<u4")[layout.words[:, None] + batch.start]
    same &= (words == layout.expected[:, None]).all(axis=0)
    for offset, wanted in layout.spans:
        found = _view(batch.buffer, f"V{len(wanted)}")[batch.start + offset]
        there = found.view("u1").reshape(len(batch), len(wanted))
        same &= (there == np.frombuffer(wanted, "u1")).all(axis=1)
    return same


def _view(buffer: Buffer, kind: str, shape: tuple[int, ...] = ()) -> Any:
    """The buffer as numbers, or as arrays of that many, starting at every byte."""
    dtype = np.dtype(kind)
    places = max(0, len(buffer) - dtype.itemsize * math.prod(shape) + 1)
    return np.ndarray(
        (places, *shape), dtype, buffer, strides=(1, *(dtype.itemsize for _ in shape))
    )


def is_strings(description: FieldDesc) -> bool:
    """Whether it is an array of strings."""
    if description[0] not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return False
    element: FieldDesc = description[1][0]
    return element[0] == Nodetype.BASE and element[1][0] == "string"


class _Walk:
    """One message, walked from its start as far as its layout matters."""

    def __init__(self, gatherer: Gatherer, data: bytes) -> None:
        if len(data) < ENCAPSULATION or data[0] != 0 or data[1] > 1:
            raise BagError(f"not a '{gatherer.msgtype}': not CDR, starts with {data[:4].hex(' ')}")
        self._of = gatherer
        self._data = data
        self._order = "<" if data[1] else ">"
        self._at = ENCAPSULATION
        self._words: list[int] = []
        self._spans = [(0, data[:2])]
        self._leaves: dict[int, tuple[int, Kind]] = {}
        self._texts: dict[int, object] = {}
        self._missing = len(gatherer.targets)
        self._steps = 0

    def layout(self) -> Layout:
        whole = self._struct(self._of.msgtype, [(i, 0) for i in range(len(self._of.targets))])
        if whole and len(self._data) > self._at + PADDING:
            raise BagError(
                f"not a '{self._of.msgtype}': the message has {len(self._data)} bytes, "
                f"one with its lengths has {self._at}"
            )
        words = np.array(self._words, dtype=np.int64)
        expected = _view(self._data, "<u4")[words]
        texts = tuple(self._texts.items())
        return Layout(self._groups(), texts, words, expected, tuple(self._spans), self._at, whole)

    def _groups(self) -> tuple[Group, ...]:
        """The leaves by kind, in the order of the targets."""
        by_kind: dict[Kind, list[tuple[int, int]]] = {}
        for target, (offset, kind) in self._leaves.items():
            by_kind.setdefault(kind, []).append((target, offset))
        return tuple(
            Group(kind, *np.array(leaves, dtype=np.int64).T) for kind, leaves in by_kind.items()
        )

    def _struct(self, msgtype: str, wanted: list[tuple[int, int]]) -> bool:
        """Walk a message; False once the rest of it cannot matter."""
        keys: dict[str, list[str]] = {}
        hops = [(i, depth, self._of.targets[i][depth]) for i, depth in wanted]
        key_fields = {hop.key[0] for _, _, hop in hops if hop.key is not None}
        for name, description in self._of.types.fielddefs[msgtype][1]:
            here = [(i, depth, hop) for i, depth, hop in hops if hop.field == name]
            if not self._missing and not self._of.is_static(description):
                return False
            if name in key_fields or (here and is_strings(description)):
                keys[name] = self._strings(description)
                for i, _, hop in here:
                    found: Any = keys[name]
                    if hop.picks:
                        found = found[self._place(hop, len(found), keys)]
                    self._tell(i, found)
            elif not self._field(description, here, keys):
                return False
        return True

    def _field(
        self,
        description: FieldDesc,
        here: list[tuple[int, int, Step]],
        keys: dict[str, list[str]],
    ) -> bool:
        if description[0] == Nodetype.NAME:
            return self._struct(str(description[1]), [(i, depth + 1) for i, depth, _ in here])
        if description[0] == Nodetype.BASE:
            self._base(str(description[1][0]), [i for i, _, _ in here])
            return True
        element, length = description[1]
        count = int(str(length)) if description[0] == Nodetype.ARRAY else self._word()
        places: dict[int | None, list[tuple[int, int]]] = {}
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
                if not self._struct(str(element[1]), [(i, depth + 1) for i, depth in inside]):
                    return False
            else:
                self._base(str(element[1][0]), [i for i, _ in inside])
            self._count_step()
        return True

    def _place(self, hop: Step, count: int, keys: dict[str, list[str]]) -> int | None:
        """The element that is meant; None for the whole array."""
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
        if place is not None and place >= count:
            raise BagError(f"'{hop.field}' has {count} elements")
        return place

    def _base(self, name: str, wanted: list[int]) -> None:
        if name == "string":
            text = self._string()
            for i in wanted:
                self._spans.append((self._at - len(text) - 1, text + b"\0"))
                self._tell(i, text.decode("utf-8", "replace"))
            return
        self._numbers(name, 1, {0: [(i, 0) for i in wanted]})

    def _tell(self, target: int, text: object) -> None:
        self._texts[target] = text
        self._missing -= 1

    def _numbers(
        self, name: str, count: int, places: dict[int | None, list[tuple[int, int]]]
    ) -> None:
        if name not in NUMBERS:
            raise BagError(f"a '{self._of.msgtype}' holds a {name}, which cannot be read")
        kind = NUMBERS[name]
        size = int(kind[1:])
        if count:
            self._align(size)
        for place, wanted in places.items():
            of = Kind(self._order + kind, name == "bool", count if place is None else None)
            for i, _ in wanted:
                self._leaves[i] = (self._at + (place or 0) * size, of)
                self._missing -= 1
        self._at += count * size
        self._check_end()

    def _word(self) -> int:
        """A string's or sequence's length; it becomes part of the layout."""
        self._align(4)
        self._at += 4
        self._check_end()
        self._words.append(self._at - 4)
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
        found = []
        for _ in range(count):
            text = self._string()
            self._spans.append((self._at - len(text) - 1, text + b"\0"))
            found.append(text.decode("utf-8", "replace"))
            self._count_step()
        return found

    def _align(self, size: int) -> None:
        self._at += -(self._at - ENCAPSULATION) % size

    def _check_end(self) -> None:
        if self._at > len(self._data):
            raise BagError(
                f"not a '{self._of.msgtype}': the message has {len(self._data)} bytes, "
                f"one with its lengths has at least {self._at}"
            )

    def _count_step(self) -> None:
        self._steps += 1
        if self._steps > MAX_STEPS:
            raise BagError(f"a '{self._of.msgtype}' of more than {MAX_STEPS} elements")
