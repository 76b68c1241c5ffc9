"""The chain on the shipped F1TENTH bags: errors, proofs, monitoring, seconds.

python -m benchmarks.f1tenth [--json]

Beside these is what was measured first on these trials (four lags, all but the test trials):
least squares 11.7 %, simulation-error minimum about 8.5 %.
"""

import statistics
import tempfile
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from bags.chain.config import Config, load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.monitoring.replay import Replay, replay_bag
from bags.samples import f1tenth
from benchmarks.machine import parser, tell
from benchmarks.recorded import is_proved
from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification import Model, Polynomial, simulation_percent
from nlsid_core.identification.methods.rse import robust_simulation_error
from nlsid_core.identification.polynomial.implicit_rie import minimise_implicit_rie
from nlsid_core.identification.polynomial.moments import rows_without_bias
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.repeats import compare_repeats
from nlsid_core.progress import silent
from nlsid_core.running.reading import Status

CHECKS = 11  # repetitions of the check; the median is reported
BEFORE = {"ls": 11.7, "final": 9.5, "sem": 8.5, "test_trials_inside": 8, "sabotaged_caught": 16}


def measure() -> dict[str, float | int | bool]:
    """Run the chain once and return the promised keys; errors in %, times in s."""
    config = load_config(config_file("f1tenth.yaml"))
    bags = f1tenth()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        started = time.perf_counter()
        result = identify_bags(bags, config, out, progress=silent)
        identify_seconds = time.perf_counter() - started
        design_funnel_files(out / documents.MODEL, config, out)
        proofs = [out / documents.MODEL_PROOF, out / documents.FUNNEL_PROOF]
        seconds = []
        for _ in range(CHECKS):
            started = time.perf_counter()
            proved = all(is_proved(path) for path in proofs)
            seconds.append(time.perf_counter() - started)
        inside, caught = monitored(config, bags, out)
        lags = len(documents.load_model(out / documents.MODEL))
    errors = {c.method.name: c.error_percent(result.test) for c in result.fit.candidates}
    repeats = bias_removed(result.train, result.test, lags)
    return {
        "ls": errors["least_squares"],
        "first": simulation_percent(first_iterate(result.train, lags), result.test),
        "final": errors["rse"],
        "sem": errors["sem"],
        **repeats,
        "proved": proved,
        "test_trials_inside": sum(r.verdict == Status.INSIDE.value for r in inside),
        "sabotaged_caught": sum(r.first_bad is not None for r in caught),
        "identify_seconds": identify_seconds,
        "check_seconds": statistics.median(seconds),
    }


def first_iterate(train: Dataset, lags: int) -> Model:
    """The model that minimises the first bound of the robust simulation error."""
    problem = build_state_affine_rows(train, Polynomial(lags))
    first = next(robust_simulation_error(problem.rows))
    model: Model = problem.model(first.theta, first.p)
    return model


def bias_removed(train: Dataset, test: Dataset, lags: int) -> dict[str, float | int | bool]:
    """The linear RIE through moments of the repeated steps, without and with the bias of noise.

    rie_pairs_refused counts the claimed pairs whose difference is more than noise: the trials
    repeat a command, not exactly a motion, so the test of repeats is skipped in the fit.
    """
    groups = list(train.repeats().values())
    repeated = Dataset(tuple(trial for group in groups for trial in group))
    model_class = Polynomial(lags, set="3.8")
    alone = [replace(trial, group=trial.name) for trial in repeated]
    biased = Dataset(tuple(trial for trial in alone for _ in range(2)))  # repeats of themselves
    unbiased, naive = (
        minimise_implicit_rie(rows_without_bias(data, model_class, accept_untested_repeats=True))
        for data in (repeated, biased)
    )
    pairs = [compare_repeats(*pair) for group in groups for pair in combinations(group, 2)]
    return {
        "rie_moments": simulation_percent(unbiased.model, test),
        "rie_naive": simulation_percent(naive.model, test),
        "rie_pairs": len(pairs),
        "rie_pairs_refused": sum(map(bool, pairs)),
    }


def monitored(config: Config, bags: list[Path], out: Path) -> tuple[list[Replay], list[Replay]]:
    """Replays of the test trials, and of each with each sensor fault."""
    proved = documents.load(out / documents.FUNNEL)
    centre = config.monitor.nominal_source
    test = [bag for bag in bags if bag.name in config.split.test]
    clean = [replay_bag(proved, bag, centre=centre) for bag in test]
    faulty = []
    for bag in test:
        for name, fault in FAULTS.items():
            copy = out / f"{bag.name} {name}"
            write_faulty_copy(bag, copy, config.signals.response[0].path, fault)
            faulty.append(replay_bag(proved, copy, centre=centre))
    return clean, faulty


def main() -> None:
    """Print the figures, and with --json one JSON object as the last line."""
    tell(measure(), BEFORE, as_json=parser(__doc__).parse_args().json)


if __name__ == "__main__":
    main()
