"""The kernel: its size, its imports, its processor seconds for examples/, and attacks on it.

    python -m benchmarks.kernel [--json] [--mutations N] [--kinds KIND ...] [--processes N]
                                [--no-designs]

A time is the least of three `kernel.check` of a saved proof, in processor seconds of one process.
Lines are those that are not blank; statements are `ast.stmt` nodes without docstrings. hostile_s is
the longest of files that were made to take long, with the limits. A mutant is a structured change
of a proof of version 2 or of a file it is about; each that is proved is decided a second time by an
oracle (tests/core/kernel), in fractions: `judged` counts them by kind. They are made in blocks,
each from a seed of its own, so that the counts are the same for any number of processes.
"""

import ast
import contextlib
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import parser, tell
from nlsid_core import files, kernel
from nlsid_core.deciding import Deciding
from nlsid_core.errors import CertificateRejected
from nlsid_core.kernel import KINDS

DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef
FOLDER = Path(kernel.__file__).parent
REPEATS = 3
MUTATIONS = 2000
SEED = 3
BLOCK = 5000  # mutants
REACHED = {  # what was aimed at
    "statements": 1900,
    "kernel_lines": 2500,
    "largest_claim_lines": 1200,
    "largest_file": 350,
    "imports_outside_stdlib": 0,
    "satellite_s": 0.6,
    "quadrotor_s": 2.4,
    "cart_pole_s": 2.0,
    "hostile_s": 20.0,
    "false_proved": 0,
}


def main() -> None:
    """Print the figures; the last line is one JSON object with --json."""
    taken = parser(__doc__ or "")
    taken.add_argument("--mutations", type=int, default=MUTATIONS)
    taken.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS, help="to mutate")
    taken.add_argument("--processes", type=int, default=1, help="for the mutations")
    taken.add_argument("--no-designs", action="store_true", help="lines and mutations only")
    arguments = taken.parse_args()
    result: dict[str, Any] = size()
    if not arguments.no_designs:
        with tempfile.TemporaryDirectory() as folder:
            result |= times(Path(folder))
    result |= {"hostile_s": hostile()}
    result |= mutated(arguments.mutations, arguments.processes, arguments.kinds)
    tell(result, REACHED, as_json=arguments.json, what="asked")


def size() -> dict[str, Any]:
    """Lines, and imports that are not of the standard library."""
    lines = {path.stem: _lines(path) for path in FOLDER.glob("*.py")}
    claims = {kind: sum(lines[name] for name in _closure(kind)) for kind in KINDS}
    largest = max(claims, key=lambda kind: claims[kind])
    outside = {name for path in FOLDER.glob("*.py") for name in _imports(path)[1]}
    return {
        "statements": sum(map(_statements, FOLDER.glob("*.py"))),
        "kernel_lines": sum(lines.values()),
        "largest_file": max(lines.values()),
        "largest_claim": largest,
        "largest_claim_lines": claims[largest],
        "claim_lines": claims,
        "imports_outside_stdlib": len(outside - sys.stdlib_module_names),
    }


def hostile() -> float:
    """The longest that a hostile file takes the kernel's process, with the limits, in s."""
    from tests.core.kernel.hostile_claims import hostile as made

    longest = 0.0
    for document, about in made().values():
        contents = {name: files.encode(content) for name, content in about.items()}
        at_work = Deciding.of(files.encode(document), contents)
        began = os.times().children_user
        with contextlib.suppress(CertificateRejected):
            at_work.wait()
        longest = max(longest, os.times().children_user - began)
    return longest


def times(folder: Path) -> dict[str, Any]:
    """Processor seconds of `kernel.check`, and MB of the proofs."""
    result: dict[str, Any] = {}
    sizes: dict[str, float] = {}
    margins: dict[str, float] = {}
    from benchmarks.shipped import shipped  # designs need solvers, attacks only the kernel

    for name, paths in shipped(folder):
        found = [_checked(path) for path in paths]
        result[f"{name}_s"] = sum(seconds for seconds, _ in found)
        sizes[name] = sum(path.stat().st_size for path in paths) / 1e6
        margins[name] = min(float(verdict.margin) for _, verdict in found)
    return result | {"files_mb": sizes, "margins": margins}


def mutated(count: int, processes: int = 1, kinds: Sequence[str] = KINDS) -> dict[str, Any]:
    """How many mutants were decided, judged by an oracle, and proved wrongly."""
    blocks = [(k, min(BLOCK, count - k * BLOCK), kinds) for k in range(-(-count // BLOCK))]
    totals, judged, seconds = Counter[str](), Counter[str](), 0.0
    with ProcessPoolExecutor(processes) as pool:
        for done, found in enumerate(pool.map(_mutated_block, *zip(*blocks, strict=True)), 1):
            seconds += found.pop("seconds")
            judged.update(found.pop("judged"))
            totals.update(found)
            if processes > 1:
                print(f"{done} of {len(blocks)}: {dict(totals)}", file=sys.stderr, flush=True)
    return {"mutations": count, "mutations_s": seconds, **totals, "judged": dict(judged)}


def _mutated_block(block: int, count: int, kinds: Sequence[str]) -> dict[str, Any]:
    from tests.core.kernel import mutations

    started = time.process_time()
    outcomes = mutations.run(count, np.random.default_rng([SEED, block]), kinds)
    return outcomes | {"seconds": time.process_time() - started}


def _checked(proof: Path) -> tuple[float, kernel.Verdict]:
    seconds = []
    for _ in range(REPEATS):
        started = time.process_time()
        verdict = kernel.check(proof)
        seconds.append(time.process_time() - started)
    return min(seconds), verdict


def _statements(path: Path) -> int:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    bodies = [node.body[0] for node in nodes if isinstance(node, DOCUMENTED) and node.body]
    strings = [first for first in bodies if isinstance(first, ast.Expr)]
    return sum(isinstance(node, ast.stmt) for node in nodes) - len(strings)


def _lines(path: Path) -> int:
    return sum(1 for line in path.read_text().splitlines() if line.strip())


def _closure(name: str) -> set[str]:
    """A module of the kernel and all that it imports there."""
    found, waiting = set[str](), [name]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += _imports(FOLDER / f"{current}.py")[0]
    return found


def _imports(path: Path) -> tuple[list[str], set[str]]:
    """The modules of the kernel that a file imports, and the others, by their first name."""
    inside: list[str] = []
    outside: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            outside |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level and node.module:
            inside.append(node.module)
        elif isinstance(node, ast.ImportFrom) and node.level:
            inside += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            outside.add(node.module.partition(".")[0])
    return inside, outside


if __name__ == "__main__":
    main()
