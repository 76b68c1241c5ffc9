"""Pictures of funnels show what was proved: projections, volumes, widths, margins."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection

from bags.pictures.funnel_plots import funnel_picture, state_pairs, write_funnel_picture
from examples import one_dimensional
from examples.satellite_funnel import goal_matrix, problem
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel

pytestmark = pytest.mark.pictures


@pytest.fixture(scope="module")
def satellite() -> FunnelDesign:
    field, nominal, weights = problem(13)
    return design_funnel(ContinuousTracking(field, nominal, goal=goal_matrix(), **weights))


@pytest.mark.parametrize(
    ("n", "pairs"),
    [
        (1, []),
        (2, [(0, 1)]),
        (3, [(0, 1), (1, 2)]),
        (5, [(0, 1), (2, 3), (3, 4)]),
        (6, [(0, 1), (2, 3), (4, 5)]),
        (12, [(0, 1), (2, 3), (4, 5)]),
    ],
)
def test_states_are_drawn_in_pairs(n: int, pairs: list[tuple[int, int]]) -> None:
    assert state_pairs(n) == pairs


def test_the_tube_is_drawn_where_the_funnel_is(satellite: FunnelDesign) -> None:
    figure = funnel_picture(satellite)
    assert len(figure.axes) == 6
    funnel = satellite.funnel
    for axes, pair in zip(figure.axes, state_pairs(6), strict=False):
        (tube,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
        drawn = np.vstack([path.vertices for path in tube.get_paths()])
        half = np.sqrt(np.linalg.inv(funnel.shape(funnel.t0))[pair[0], pair[0]])
        leftmost = funnel.nominal(funnel.t0)[pair[0]] - half
        assert drawn[:, 0].min() <= leftmost + 1e-3
        labels = [text.get_text() for text in (axes.xaxis.label, axes.yaxis.label)]
        assert labels == [f"x{i}" for i in pair]


def test_volumes_widths_and_margins_are_the_funnels(satellite: FunnelDesign) -> None:
    volume, widths, margin = funnel_picture(satellite).axes[3:]
    first, proved = volume.get_lines()
    assert first.get_label() == "first guess, not proved"
    assert np.asarray(proved.get_ydata())[0] == satellite.funnel.volume(0.0)
    assert np.asarray(first.get_ydata())[0] == satellite.found.first.volume(0.0)
    assert len(widths.get_lines()) == 6
    (pieces,) = [c for c in margin.collections if isinstance(c, LineCollection)]
    heights = np.array([segment[0, 1] for segment in pieces.get_segments()])
    assert heights == pytest.approx(satellite.found.proved.margins)


@pytest.mark.slow
def test_one_state_is_drawn_over_time(tmp_path: Path) -> None:
    design = one_dimensional.designed()
    figure = funnel_picture(design)
    assert [axes.xaxis.label.get_text() for axes in figure.axes] == ["time [s]"] * 4
    write_funnel_picture(tmp_path / "funnel.png", design)
    assert (tmp_path / "funnel.png").read_bytes().startswith(b"\x89PNG")
