"""What is chosen of bags that are copied, and how the copy is written: the options of `convert`."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True)
class What:
    """What of the old bags is copied. A moment is s after the first message, or a date in UTC."""

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

    storage: Annotated[str, "mcap, sqlite3 or ros1."] = "mcap"
    compression: Annotated[str, "Of mcap: zstd, lz4 or none."] = "zstd"
    every: Annotated[float | None, "s per part: OUT_01, OUT_02, ..."] = None
    max_size: Annotated[float | None, "MB per part."] = None
