"""What the commands print fits 80 columns, with every number whole."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from bags.commands import show
from bags.commands.cli import app
from bags.monitoring.replay import Replay
from bags.pictures import tables
from bags.tools.fitness import LEAST_OVERLAP
from nlsid import Dataset, Degrees, Polynomial, Rse, Sem, Status, Trajectory, identify
from nlsid_core.running.reading import Reading
from tests.bag_messages import COMMAND, SPEED, speed_bag


def printed(table: object) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def replay(*readings: Reading) -> Replay:
    return Replay("run_of_a_tank", readings, (), "temperature", "degC", 1.0, period=0.5)


def test_what_a_monitor_says_of_the_worst_bag_is_not_cut() -> None:
    bad = Reading(
        231.0, Status.ASSUMPTION_VIOLATED, -151.816, 736897.47, worst_axis="temp temperature"
    )
    text = printed(show.replay_table([replay(bad)]))
    row = [line.split() for line in text.splitlines()][3:]
    words = {word for line in row for word in line}
    assert {"assumption", "violated", "-151.816", "231.000", "10000", "0.5", "s"} <= words
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_name_that_fits_beside_the_numbers_stays_whole() -> None:
    inside = Reading(9.85, Status.INSIDE, 0.861, 0.12, worst_axis="position")
    bad = Reading(34.8, Status.ASSUMPTION_VIOLATED, -2.588, 200.0, worst_axis="position")
    named = [replace(replay(r), name=n) for r, n in ((inside, "duffing_test_0"), (bad, "x" * 30))]
    text = printed(show.replay_table(named))
    assert "duffing_test_0" in text.split()
    assert text.count("x") - text.count("axis") == 30
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("last", [0.01, float("nan")])
def test_what_is_used_is_the_most_that_a_sample_used(last: float) -> None:
    fading = (
        Reading(0.0, Status.INSIDE, 0.5, 0.4),
        Reading(0.5, Status.ASSUMPTION_VIOLATED, 0.5, 1.25),
        Reading(1.0, Status.INSIDE, 0.5, last),
    )
    assert replay(*fading).assumption == 1.25
    assert np.isnan(replay(Reading(0.0, Status.INSIDE, 0.5)).assumption)
    assert np.isnan(replay().assumption)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "method"),
    [
        (Polynomial(1, (1,), Degrees(left=3), set="3.8"), Sem(certified=True)),
        (Polynomial(2), Rse()),
    ],
)
def test_the_rate_of_a_method_with_a_long_name_is_not_cut(kind: Any, method: Any) -> None:
    rng, trials = np.random.default_rng(1), []
    for name in ("a", "b"):
        u = np.repeat(rng.uniform(-1, 1, 20), 10)[:, None]
        y = np.zeros((200, 1))
        for k in range(199):
            y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
        trials.append(Trajectory(t=0.1 * np.arange(200), y=y, u=u, name=name))
    data = Dataset(tuple(trials))
    fit = identify(data, kind, method=method, test=data)
    text = printed(tables.methods_table(fit, data))
    assert "…" not in text
    assert all(len(line) == 80 for line in text.splitlines() if line.startswith("│"))
    proved = [c.proof for c in fit.candidates if c.proof is not None]
    assert len(proved) == len(fit.candidates) > 1
    for candidate in fit.candidates:
        assert tables.stability(candidate).removeprefix("[green]") in text


def test_a_recording_too_short_for_a_delay_is_said_to_be_short(tmp_path: Path) -> None:
    bag = tmp_path / "short"
    few = np.arange(LEAST_OVERLAP // 2, dtype=float)
    speed_bag(bag, few, few)
    done = CliRunner().invoke(app, ["bag", "check", str(bag), "-u", COMMAND, "-y", SPEED])
    assert "do not overlap" not in done.output
    assert f"less than {LEAST_OVERLAP} steps of the response" in " ".join(done.output.split())
