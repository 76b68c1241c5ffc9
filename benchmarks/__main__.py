"""All benchmarks, one after the other: a JSON file each, with date, machine and commit.

python -m benchmarks [--data DIR] [--out DIR] [--limit SECONDS] [NAME ...]

--data is the folder of the recordings that do not ship with the project, one folder in it for each
source (`exchanger`, `wh2009`, `emps`, ...); it is only read. A benchmark that fails, takes too long
or lacks its data is named at the end, with status 1, and leaves no file.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.machine import describe

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
LIMIT = 5400.0  # s for one benchmark


@dataclass(frozen=True)
class Benchmark:
    """How one is run.

    module: of this folder. data: the folder below --data that it reads, "." for the whole of it.
    """

    module: str
    arguments: tuple[str, ...] = ()
    data: str | None = None

    def command(self, data: Path | None) -> list[str]:
        """Run it in this Python; raises FileNotFoundError if its recordings are not there."""
        command = [sys.executable, "-m", f"benchmarks.{self.module}", *self.arguments, "--json"]
        if self.data is None:
            return command
        if data is None or not (data / self.data).is_dir():
            raise FileNotFoundError(f"needs --data with the folder {self.data}")
        return [*command, "--data", str(data / self.data)]


BENCHMARKS: Mapping[str, Benchmark] = MappingProxyType(
    {
        "bag_reading": Benchmark("bag_reading"),
        "f1tenth": Benchmark("f1tenth"),
        "faults": Benchmark("faults"),
        "fleet": Benchmark("fleet"),
        "funnel_scaling": Benchmark("funnel_scaling", ("--most", "16")),
        "heat_exchanger": Benchmark("heat_exchanger", data="exchanger"),
        "first_try": Benchmark("first_try"),
        "kernel": Benchmark("kernel"),
        "monitor": Benchmark("monitor"),
        "nonlinear": Benchmark("nonlinear", data="."),
        "recorder": Benchmark("recorder"),
        "repeated_experiments": Benchmark("repeated_experiments", ("--minutes", "70")),
        "satellite": Benchmark("satellite"),
        "tubes": Benchmark("tubes", data="."),
        "verified": Benchmark("verified"),
        "wiener_hammerstein": Benchmark("wiener_hammerstein", data="wh2009"),
    }
)


def measured(benchmark: Benchmark, data: Path | None, limit: float) -> dict[str, Any]:
    """Run it and return everything that its file holds.

    Raises FileNotFoundError if its data are missing, subprocess.SubprocessError if it fails or
    takes longer than `limit` (s), ValueError if its last line is not one JSON value.
    """
    command = benchmark.command(data)
    started, date, load = time.monotonic(), datetime.now(UTC), os.getloadavg()[0]
    with subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            written, _ = process.communicate(timeout=limit)
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)  # and what it started: nodes, workers
            raise
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return {
        "command": ["python", *(_without(data, word) for word in command[1:])],
        "date": date.isoformat(timespec="seconds"),
        "machine": describe(),
        "commit": commit(),
        "load": [round(load, 1), round(os.getloadavg()[0], 1)],  # of a minute, before and after
        "seconds": round(time.monotonic() - started, 1),
        "result": json.loads(written.strip().rpartition("\n")[2]),
    }


def _without(data: Path | None, word: str) -> str:
    """A word of the command that names no folder of this machine."""
    return word if data is None else word.replace(str(data), "DATA")


def commit() -> str:
    """The commit of the checkout; with `+changes` if it is not clean, `unknown` without git."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--", ".", f":!{RESULTS.relative_to(ROOT)}")
        return git("rev-parse", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def main() -> None:
    """Run them and write OUT/NAME.json each; status 1 if one has no result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="which; default: all")
    parser.add_argument("--data", type=Path, help="folder of the recordings that do not ship")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"default: {RESULTS}")
    parser.add_argument("--limit", type=float, default=LIMIT, help="s for one of them")
    options = parser.parse_args()
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(BENCHMARKS)}")
    options.out.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    missing = []
    for name in options.names or BENCHMARKS:
        print(f"{name} ...", flush=True)
        try:
            found = measured(BENCHMARKS[name], options.data, options.limit)
        except (OSError, subprocess.SubprocessError, ValueError) as error:
            missing.append(f"{name}: {error}")
            continue
        (options.out / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")
        print(f"{name}: {found['seconds']} s, wrote {options.out / name}.json", flush=True)
    for line in missing:
        print(f"no result: {line}")
    sys.exit(1 if missing else 0)


if __name__ == "__main__":
    main()
