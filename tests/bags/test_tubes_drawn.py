"""Pictures of motions: a tube is drawn as wide as it was proved, a free run as it was chosen."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from bags.pictures.tubes import draw_free_run, state_pairs, write_tube
from nlsid import Dataset, Design, Trajectory, plot
from nlsid_core.designs import AnyDesign
from nlsid_core.identification.states import free_run_error
from tests.continuous_stage import stage
from tests.tracked import PERIOD, designed, pendulum

pytestmark = pytest.mark.pictures


@pytest.mark.parametrize(
    "made",
    [
        lambda tube: tube,
        lambda tube: replace(tube, policy=None),
        lambda _: designed(),
        lambda _: Design(*stage()),
    ],
    ids=["plan", "no plan", "sampled", "continuous"],
)
def test_the_tube_is_drawn_as_wide_as_it_was_proved(made: Any, tube: Any, tmp_path: Path) -> None:
    design: AnyDesign = made(tube)
    figure = plot(design)
    assert len(figure.axes) == len(design.signals[0])
    for i, axes in enumerate(figure.axes):
        (drawn,) = (c for c in axes.collections if isinstance(c, PolyCollection))
        points = np.asarray(drawn.get_paths()[0].vertices)
        first = points[points[:, 0] == points[:, 0].min(), 1]
        assert np.ptp(first) == pytest.approx(2.0 * design.funnel.widths(0)[i])
    write_tube(tmp_path / "tube.png", design)
    assert (tmp_path / "tube.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("n", "pairs"),
    [(1, []), (2, [(0, 1)]), (3, [(0, 1), (1, 2)]), (12, [(0, 1), (2, 3), (4, 5)])],
)
def test_states_are_drawn_in_pairs(n: int, pairs: list[tuple[int, int]]) -> None:
    assert state_pairs(n) == pairs


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
    figure = draw_free_run(model, Dataset(tuple(trials)))
    error = free_run_error(model, Dataset((trials[1],)))
    assert f"worse, the worst that was not fitted: {error:.2g} %" in str(figure.get_suptitle())
    outside = ((worse < model.x_range[:, 0]) | (worse > model.x_range[:, 1])).any(axis=1)
    assert outside.any()
    for i, axes in enumerate((figure.axes[0], figure.axes[2])):
        measured, simulated = (np.asarray(drawn.get_ydata()) for drawn in axes.get_lines())
        np.testing.assert_array_equal(measured, worse[:, i])
        assert np.isnan(simulated[outside]).all()
