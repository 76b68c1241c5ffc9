"""What every benchmark shares: its options, its clock, its figures, and the machine it ran on."""

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


def parser(doc: str, *, data: bool = False) -> argparse.ArgumentParser:
    """Take --json, and --data where recordings are needed that do not ship.

    Args:
        doc: The benchmark's docstring, whose first line is the help.
        data: Whether a folder of recordings has to be given.
    """
    made = argparse.ArgumentParser(description=doc.splitlines()[0])
    made.add_argument("--json", action="store_true", help="last line is one JSON object")
    if data:
        made.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    return made


def tell(
    result: Mapping[str, Any],
    beside: Mapping[str, Any] | None = None,
    *,
    as_json: bool,
    what: str = "published",
) -> None:
    """Print figures, one a line with another beside it; last, as one JSON object.

    Args:
        result: The figures by key; groups of figures are shown by their dotted keys.
        beside: The others, by dotted key.
        as_json: Whether the last line is JSON.
        what: What the others are.
    """
    print(f"\n{describe()}")
    for key, value in _dotted(result):
        shown = f"{value:.5g}" if isinstance(value, float) else str(value)
        other = f"   ({what} {beside[key]})" if beside and key in beside else ""
        print(f"{key:34} {shown:>12}{other}")
    if as_json:
        print(json.dumps(result))


def _dotted(result: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in result.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{before}{key}.")
        else:
            yield before + key, value


class Spent:
    """Wall-clock and processor time, in s, of what was done under `spending`."""

    seconds = processor = float("nan")


@contextmanager
def spending() -> Iterator[Spent]:
    """Measure what is done inside; the times are there when it is done."""
    spent = Spent()
    started, busy = time.perf_counter(), time.process_time()
    yield spent
    spent.seconds, spent.processor = time.perf_counter() - started, time.process_time() - busy


def describe() -> str:
    """The processor's name, how many cores this process may use, and Python's version."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = [
            line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        name = models[0].partition(":")[2].strip() if models else name
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    return f"{name}, {threads} thread(s), Python {platform.python_version()}"


def peers(*distributions: str) -> dict[str, dict[str, str]]:
    """{"peers": {distribution: version}} of what ours is measured beside, for the JSON result."""
    versions = {}
    for name in distributions:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return {"peers": versions}
