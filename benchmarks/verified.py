"""The second kernel (verified/): proofs of the examples in Coq and extracted; mutants of both.

    python -m benchmarks.verified [--json] [--mutations N] [--no-designs] [--no-tests]

Needs Debian's coq, libcoq-bignums, ocaml-findlib and libzarith-ocaml-dev. Seconds are processor
seconds: of make with one theorem, the theory being built, and of the extracted checker with the
generator. A mutant is that of tests/core/kernel; those that the second kernel does not cover cannot
disagree. A disagreement is listed by what each kernel said of it. Recorded are the files that the
first kernel's tests ask it about, forged or not; both are asked again.
"""

import importlib
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import parser, tell
from benchmarks.shipped import shipped
from nlsid_core import files, kernel, second
from tests.core.kernel import mutations
from tests.core.verified import recorded

ROOT = Path(__file__).resolve().parents[1]
VERIFIED = ROOT / "verified"
MUTATIONS = 10_000
SEED = 4
KINDS = ("continuous_funnel", "tube", "stability", "sampled_funnel", "funnel_composition")
TESTS = "tests/core"


def main() -> None:
    """Print the figures; the last line is one JSON object with --json."""
    options = parser(__doc__)
    options.add_argument("--mutations", type=int, default=MUTATIONS)
    options.add_argument("--no-designs", action="store_true", help="without the examples' proofs")
    options.add_argument("--no-tests", action="store_true", help="without the tests' files")
    arguments = options.parse_args()
    theory = [path.read_text().splitlines() for path in VERIFIED.glob("*.v")]
    result: dict[str, Any] = {"lines": sum(bool(line.strip()) for text in theory for line in text)}
    with tempfile.TemporaryDirectory() as folder:
        build = Path(folder) / "build"
        make = ["make", "-s", "-C", str(VERIFIED), f"BUILD={build}"]
        for targets in ([], ["second"]):
            subprocess.run([*make, *targets], check=True, stdout=subprocess.DEVNULL)
        program = build / "nlsid-second"
        if not arguments.no_designs:
            result |= decided(Path(folder), make, program)
        if not arguments.no_tests:
            result |= tested(Path(folder) / "recorded", build / "second")
        result |= mutated(arguments.mutations, Path(folder) / "mutant", build / "second")
    tell(result, as_json=arguments.json)


def decided(folder: Path, make: list[str], program: Path) -> dict[str, Any]:
    """`accepted`, or why not, and the seconds in Coq and extracted, for every shipped proof."""
    accepted: dict[str, str] = {}
    coq: dict[str, float] = {}
    extracted: dict[str, float] = {}
    for name, paths in shipped(folder):
        for path in paths:
            label = f"{name}/{path.name}"
            before = _children()
            opinion = second.opinion(path, program)
            accepted[label] = opinion.reason or opinion.verdict
            if opinion.verdict != "accepted":
                continue
            extracted[label] = _children() - before
            before = _children()
            done = subprocess.run([*make, f"FILE={path}"], check=False, capture_output=True)
            accepted[label] = "accepted" if done.returncode == 0 else "refused by Coq"
            coq[label] = _children() - before
    return {"accepted": accepted, "coq_s": coq, "extracted_s": extracted}


def mutated(count: int, folder: Path, checker: Path) -> dict[str, Any]:
    """How often the kernels have both a verdict of a mutant, and where they differ."""
    generate = generator()
    folder.mkdir()
    rng = np.random.default_rng(SEED)
    cases = [case for case in mutations.corpus() if case.kind in KINDS]
    both: Counter[str] = Counter()
    differ: Counter[str] = Counter()
    for k in range(count):
        case = cases[k % len(cases)]
        forged = mutations.mutant(case, rng)
        try:
            for name, document in {**forged.about, mutations.PROOF: forged.document}.items():
                (folder / name).write_bytes(files.encode(document))
        except (ValueError, TypeError):  # it cannot even be written
            continue
        _proved, verdict, told = opinions(folder / mutations.PROOF, generate, checker)
        both[f"{verdict} {case.kind}"] += 1
        differ.update([told] if told else [])
    return {
        "mutations": count,
        "decided": dict(sorted(both.items())),
        "disagreements": sum(differ.values()),
        "differ": dict(differ.most_common()),
    }


def tested(folder: Path, checker: Path) -> dict[str, Any]:
    """The same of the files that the first kernel's tests ask it about, forged or not."""
    generate = generator()
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", recorded.__name__, TESTS],
        check=True,
        cwd=ROOT,
        env={**os.environ, recorded.FOLDER: str(folder)},
        stdout=subprocess.DEVNULL,
    )
    both: Counter[str] = Counter()
    differ: Counter[str] = Counter()
    for case in sorted(folder.iterdir()):
        proved, verdict, told = opinions(case / recorded.PROOF, generate, checker)
        both[f"{'proved' if proved else 'refused'} and {verdict}"] += 1
        differ.update([told] if told else [])
    return {
        "recorded": dict(sorted(both.items())),
        "recorded_disagreements": sum(differ.values()),
        "recorded_differ": dict(differ.most_common()),
    }


def opinions(proof: Path, generate: Any, checker: Path) -> tuple[bool, str, str]:
    """Whether the first kernel proves it, the second's verdict; what was said if they differ."""
    said = "proved"
    try:
        kernel.check(proof)
    except kernel.Rejected as refusal:
        said = str(refusal)
    status, why = generate.decided(proof, checker=checker)
    verdict = {0: "accepted", 1: "refused", 3: "not covered"}[status]
    differ = status != 3 and (status == 0) != (said == "proved")
    told = re.sub(r"[0-9.e+-]*[0-9]", "#", f"{verdict} {why}, but {said}")[:160] if differ else ""
    return said == "proved", f"{verdict}{named(why) if status == 3 else ''}", told


def named(why: str) -> str:
    """What is not covered, without the numbers of a case."""
    said = re.sub(r"'.*|: .*|[0-9.e+-]*[0-9]", "#", why.removeprefix("not covered: "))
    return f" ({said.rstrip('#')})"


def generator() -> Any:
    """verified/generate.py, which is a program and no part of the package."""
    sys.path.insert(0, str(VERIFIED))
    try:
        return importlib.import_module("generate")
    finally:
        sys.path.remove(str(VERIFIED))


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
