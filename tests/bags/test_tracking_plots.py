"""Pictures of a measured state show what was identified, planned, proved and watched."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D
from typer.testing import CliRunner

from bags.commands.cli import app
from bags.pictures import plots, tracking_plots
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.identification.states import free_run_error
from nlsid_core.running.assumption import disturbance_of, meter_of
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.observer import StateObserver
from nlsid_core.running.reading import Reading, Status
from tests.tracked import PERIOD, STEPS, designed, pendulum, run

pytestmark = pytest.mark.pictures

ROOT = Path(__file__).resolve().parents[2]
KICK = np.array([0.0, 0.6])


def points(drawn: Line2D) -> FloatArray:
    """(N, 2) times and values."""
    return np.asarray(drawn.get_xydata())


def runs_in(axes: Axes) -> list[Line2D]:
    """The lines with a point for each sample of the motion, less the one at zero."""
    lines = [drawn for drawn in axes.get_lines() if len(points(drawn)) == STEPS + 1]
    return [drawn for drawn in lines if points(drawn)[:, 1].any()]


def line(axes: Axes, label: str) -> FloatArray:
    """(N, 2) of the one line with this label."""
    (found,) = [drawn for drawn in axes.get_lines() if drawn.get_label() == label]
    return points(found)


def band(axes: Axes) -> tuple[FloatArray, FloatArray]:
    """(N, 2) lower and upper edge of what is shaded, over time."""
    (shaded,) = [c for c in axes.collections if not isinstance(c, LineCollection)]
    points = np.asarray(shaded.get_paths()[0].vertices)
    times = np.unique(points[:, 0])
    ends = [points[points[:, 0] == t, 1] for t in times]
    lower, upper = np.array([[v.min(), v.max()] for v in ends]).T
    return np.stack([times, lower], axis=1), np.stack([times, upper], axis=1)


def on_the_tube(k: int, count: int) -> FloatArray:
    """(count, 2) deviations on the tube's boundary at sample k."""
    angle = np.linspace(0.0, 2 * np.pi, count)
    funnel = designed().funnel
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.linalg.solve(funnel.S[k], funnel.radius[k] * circle).T)


def watched(trial: Trajectory) -> list[Reading]:
    """The readings of a run."""
    design = designed()
    monitor = Monitor(design.model, design.policy, design.funnel)
    return [
        monitor.update(float(t), y, u) for t, y, u in zip(trial.t, trial.y, trial.u, strict=True)
    ]


def test_the_tube_is_drawn_as_wide_as_it_was_proved() -> None:
    design = designed()
    figure = tracking_plots.draw_funnel(
        design.model, design.policy, design.funnel, Dataset((run(),))
    )
    for i, axes in enumerate(figure.axes[:2]):
        lower, upper = band(axes)
        assert len(lower) == STEPS + 1
        for k in (0, 7, STEPS):
            reached = design.policy.x[k, i] + on_the_tube(k, 2000)[:, i]
            assert lower[k, 1] == pytest.approx(reached.min(), rel=1e-5)
            assert upper[k, 1] == pytest.approx(reached.max(), rel=1e-5)
        np.testing.assert_array_equal(line(axes, "nominal")[:, 1], design.policy.x[:, i])
        np.testing.assert_allclose(line(axes, "nominal")[:, 0], np.arange(STEPS + 1) * PERIOD)


def test_inlet_and_goal_are_drawn_from_the_proved_radii() -> None:
    design = designed()
    funnel, policy = design.funnel, design.policy
    figure = tracking_plots.draw_funnel(design.model, policy, funnel, Dataset((run(),)))
    axis = np.sqrt(np.diagonal(np.linalg.inv(np.swapaxes(funnel.S, 1, 2) @ funnel.S), 0, 1, 2))
    for i, axes in enumerate(figure.axes[:2]):
        inlet = policy.x[:, i] + funnel.inlet * axis[:, i]
        np.testing.assert_allclose(line(axes, "inlet")[:, 1], inlet)
        (goal,) = [c for c in axes.collections if isinstance(c, LineCollection)]
        ((_, low), (_, high)) = goal.get_segments()[0]
        reach = (funnel.inlet[-1] + funnel.assumption.bound) * axis[-1, i]
        assert (low, high) == pytest.approx((policy.x[-1, i] - reach, policy.x[-1, i] + reach))


def test_the_part_the_feedback_may_use_is_the_most_it_gives_in_the_tube() -> None:
    design = designed()
    used = tracking_plots.feedback_reach(design.policy, design.funnel)
    figure = tracking_plots.draw_funnel(
        design.model, design.policy, design.funnel, Dataset((run(),))
    )
    _, upper = band(figure.axes[2])
    for k in (0, 11, STEPS - 1):
        given = on_the_tube(k, 2000) @ design.policy.K[k].T
        assert used[k, 0] == pytest.approx(given.max(), rel=1e-5)
        assert upper[k, 1] == pytest.approx(design.policy.u[k, 0] + given.max(), rel=1e-5)
    low, high = design.model.u_range[0]
    assert {low, high} <= {float(np.asarray(b.get_ydata())[0]) for b in figure.axes[2].get_lines()}


def test_the_bound_is_drawn_above_the_commissioning_runs_disturbance() -> None:
    design = designed()
    trial = run(seed=4)
    figure = tracking_plots.draw_funnel(
        design.model, design.policy, design.funnel, Dataset((trial,))
    )
    axes = figure.axes[4]
    sizes = disturbance_of(design.model, design.policy, trial, meter_of(design.funnel))
    np.testing.assert_array_equal(line(axes, "commissioning runs")[:, 1], sizes)
    a = design.funnel.assumption
    assert set(line(axes, f"assumed bound, {a.safety_factor:g} times")[:, 1]) == {a.bound}
    assert set(line(axes, "largest measured")[:, 1]) == {a.measured}


def test_runs_are_drawn_where_the_observer_was_and_in_the_colour_of_their_verdict() -> None:
    design, trial = designed(), run(kick=KICK)
    readings = watched(trial)
    figure = tracking_plots.draw_watched(design.model, design.funnel, [readings])
    observer = StateObserver(design.model, design.policy.L)
    estimate = [observer.update(y, trial.u[k - 1] if k else None) for k, y in enumerate(trial.y)]
    away = np.array(estimate) - design.policy.x
    bad = next(k for k, r in enumerate(readings) if r.status is not Status.INSIDE)
    for i, axes in enumerate(figure.axes[:2]):
        drawn = {to_hex(part.get_color()): points(part)[:, 1] for part in runs_in(axes)}
        inside = drawn[tracking_plots.COLOURS[Status.INSIDE]]
        np.testing.assert_array_equal(inside[:bad], away[:bad, i])
        assert np.isnan(inside[bad:]).all()
        for k, reading in enumerate(readings):
            assert drawn[tracking_plots.COLOURS[reading.status]][k] == away[k, i]
    margin = points(runs_in(figure.axes[2])[0])[:, 1]
    sizes = np.linalg.norm(np.einsum("kij,kj->ki", design.funnel.S, away), axis=1)
    np.testing.assert_allclose(margin[:bad], (1 - sizes / design.funnel.radius)[:bad])
    assert "0 of 1 inside" in str(figure.get_suptitle())


def test_several_runs_of_one_bag_are_drawn_apart() -> None:
    design = designed()
    readings = watched(run()) + watched(run(seed=1))
    figure = tracking_plots.draw_watched(design.model, design.funnel, [readings])
    assert "2 of 2 inside" in str(figure.get_suptitle())
    assert len(runs_in(figure.axes[2])) == 2


def test_the_free_run_is_simulated_in_the_box_only_and_of_the_worst_trial() -> None:
    model = replace(pendulum(), x_range=np.array([[-0.7, 0.7], [-4.0, 4.0]]))
    u = 2.5 * np.sin(2.3 * np.arange(600) * PERIOD)[:, None]
    good = np.vstack([[0.0, 0.0], model.simulate(np.zeros(2), u[:-1])[1:]])
    worse = good + 1e-3 * np.random.default_rng(0).standard_normal(good.shape)
    t = np.arange(600) * PERIOD
    trials = [
        Trajectory(t=t, y=y, u=u, name=name, digest=f"sha256:{name}")
        for name, y in (("good", good), ("worse", worse))
    ]
    figure = tracking_plots.draw_free_run(model, Dataset(tuple(trials)))
    error = free_run_error(model, Dataset((trials[1],)), in_box=True)
    assert "worse" in str(figure.get_suptitle())
    assert f"{error:.2g} %" in str(figure.get_suptitle())
    outside = ((worse < model.x_range[:, 0]) | (worse > model.x_range[:, 1])).any(axis=1)
    assert outside.any()
    for i, axes in enumerate((figure.axes[0], figure.axes[2])):
        np.testing.assert_array_equal(line(axes, "measured")[:, 1], worse[:, i])
        simulated = line(axes, "simulated")[:, 1]
        assert np.isnan(simulated[outside]).all()
        first = int(np.argmax(outside))
        np.testing.assert_array_equal(
            simulated[:first], model.simulate(worse[0], u[: first - 1])[:, i]
        )


def test_the_motion_is_drawn_in_the_box_of_the_data() -> None:
    design = designed()
    figure = tracking_plots.draw_motion(design.model, design.policy)
    ranges = [*design.model.x_range, *design.model.u_range]
    nominal = [*design.policy.x.T, *design.policy.u.T]
    for axes, bounds, values in zip(figure.axes, ranges, nominal, strict=True):
        np.testing.assert_array_equal(line(axes, "nominal")[:, 1], values)
        levels = {float(np.asarray(b.get_ydata())[0]) for b in axes.get_lines()}
        assert set(bounds.tolist()) <= levels


def test_a_picture_is_a_png_file(tmp_path: Path) -> None:
    design = designed()
    path = tmp_path / "motion.png"
    plots.write_png(path, tracking_plots.draw_motion(design.model, design.policy))
    assert path.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_every_step_draws_beside_its_files_and_says_so(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="simulated robots need the extra `sim`")
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    for given, shorter in (
        ("[pendulum_4_0, pendulum_4_1, pendulum_4_2, pendulum_4_3]", "[pendulum_2_0]"),
        ("duration: 1.5\n", "duration: 0.3\n"),
        ("[0.6,", "[0.1,"),
        ("groups: 5", "groups: 3"),
        ("repeats: 4", "repeats: 2"),
        ("seconds: 60.0", "seconds: 12.0"),
        ("runs: 30", "runs: 3"),
        ("identification:\n", "identification:\n  degrees: [[3, 1, 1]]\n"),
    ):
        assert given in text
        text = text.replace(given, shorter)
    config = tmp_path / "pendulum.yaml"
    config.write_text(text)
    result = CliRunner().invoke(app, ["demo", "--robot", str(config), "--out", str(tmp_path)])
    assert result.exit_code == 0, (result.output, result.exception)
    for name in ("free_run.png", "motion.png", "funnel.png", "monitor.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert f"wrote {tmp_path / name}" in result.output
    assert "3 of 3 bags are inside" in result.output
    assert "angle [rad]" in result.output
