"""The options of `nlsid bag convert` and `import`: what is copied, and how it is written."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class What:
    """The part of the old bags to copy. A moment is s after the first message, or a date in UTC."""

    topics: Annotated[list[str] | None, "Only these, by name or pattern: '/camera/*'."] = None
    start: Annotated[str, "From here on: s after the first message, or a date in UTC."] = ""
    end: Annotated[str, "To before here."] = ""
    around: Annotated[str, "Only around a moment, or around each message of a topic."] = ""
    before: Annotated[float, "s before it."] = 5.0
    after: Annotated[float, "s after it."] = 5.0
    rename: Annotated[list[str] | None, "/old=/new"] = None
    restamp: Annotated[
        str,
        "header: log by header stamps; log: stamp headers by log times; +T or -T: move by T s.",
    ] = ""


@dataclass(frozen=True)
class Into:
    """How new bags are written."""

    storage: Annotated[
        str, "mcap, sqlite3 or ros1; default: what the ending of --out says, else mcap."
    ] = ""
    compression: Annotated[str, "Of mcap: zstd (the default), lz4 or none."] = ""
    every: Annotated[float | None, "s per part: OUT_01, OUT_02, ..."] = None
    max_size: Annotated[float | None, "MB per part."] = None


@dataclass(frozen=True)
class Rows:
    """When the rows of a table were recorded: `period` s apart, or at the times of a column.

    Without a unit behind the column, `stamp|unit(ms)`, its times are in what the title says, `t_ms`
    or `t [ms]`; of times since 1970, in which of s, ms, us and ns can be meant; else in s.
    """

    period: Annotated[float | None, "s between rows."] = None
    time: Annotated[
        str | None, "The column with the rows' times; default: one called t or time."
    ] = None
    start: Annotated[float, "s since 1970 of time 0."] = 0.0
