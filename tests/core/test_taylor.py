"""Taylor models enclose what they stand for, and funnels of them hold for the true dynamics."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.known_problems import encloses, run
from nlsid_core.arrays import FloatArray
from nlsid_core.design import FunnelDesign, design_funnel, nominal_through
from nlsid_core.design.thesis.soundness import TrueDynamics, simulate_boundary
from nlsid_core.dynamics import VectorField
from nlsid_core.dynamics.taylor import expand, taylor_field
from nlsid_core.errors import CertificateRejected, DataError, ShapeError
from nlsid_core.proofs import check
from tests.funnel_files import saved, write


def swinging(x: Any, u: Any) -> list[Any]:
    """A pendulum whose drive depends on its angle."""
    return [x[1], -9.81 * np.sin(x[0]) + u[0] / (2 + np.cos(x[0])) - x[1] * x[1] / 10]


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (2.5, -3.0, 4.0), (-1.25, 0.5, -2.0)])
@pytest.mark.parametrize("size", [0.01, 0.3, 1.0])
def test_the_remainder_is_never_more_than_its_bound_and_in_small_boxes_not_much_less(
    centre: tuple[float, ...], size: float
) -> None:
    radius = size * np.array([1.0, 2.0, 3.0])
    cubics, bounds = expand(swinging, np.array(centre), radius, states=2)
    rng = np.random.default_rng(0)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    points = np.array(centre) + radius * np.vstack([rng.uniform(-1, 1, (4000, 3)), corners])
    true = np.stack(swinging(points[:, :2].T, points[:, 2:].T), axis=1)
    left = np.abs(true - np.stack([p.rounded()(points) for p in cubics], axis=1)).max(axis=0)
    rounding = 1e-13 * np.abs(true).max()  # of this test's own evaluation
    assert (left <= bounds + rounding).all()
    assert bounds[0] == 0
    if size < 1:  # in a wide box a division's series leaves much more than it has to
        assert bounds[1] <= 20 * left[1] + rounding


def test_one_over_something_that_may_be_zero_is_refused() -> None:
    with pytest.raises(DataError, match="may be zero in the box"):
        expand(lambda x, u: [u[0] / x[0]], [0.5, 0.0], [0.5, 1.0], states=1)
    with pytest.raises(ShapeError, match="1 entries for 2 states"):
        expand(lambda x, u: [x[0] + u[0]], [0.5, 0.0, 0.0], [0.5, 1.0, 1.0], states=2)


@pytest.mark.parametrize(
    ("rate", "true"),
    [
        (lambda x, u: [3 - x[0] / 3 + u[0] ** 2], lambda x, u: 3 - x / 3 + u**2),
        (lambda x, u: [1 / (4 - x[0]) - u[0]], lambda x, u: 1 / (4 - x) - u),
        (lambda x, u: [-(x[0] ** 3) * u[0]], lambda x, u: -(x**3) * u),
        (lambda x, u: [2.5 + 0 * (x[0] - u[0])], lambda x, u: 2.5 + 0 * x * u),
    ],
)
def test_every_operation_encloses(rate: Any, true: Any) -> None:
    centre, radius = np.array([1.0, -0.5]), np.array([0.5, 0.75])
    (cubic,), bounds = expand(rate, centre, radius, states=1)
    points = centre + radius * np.random.default_rng(1).uniform(-1, 1, (2000, 2))
    left = np.abs(true(points[:, 0], points[:, 1]) - cubic.rounded()(points))
    assert (left <= bounds[0] + 1e-14).all()


# -- funnels -----------------------------------------------------------------------------------


def caught() -> tuple[VectorField, FunnelDesign]:
    """The pendulum above, brought to rest in 0.4 s, cubic models of 8 intervals."""
    t = np.linspace(0, 0.4, 9)
    x = np.zeros((9, 2))
    field = taylor_field(swinging, t, x, np.zeros((9, 1)), radius=[0.4, 3.0, 30.0])
    nominal = nominal_through(t, x, np.zeros((9, 1)), field)
    return field, design_funnel(field, nominal, goal=30 * np.eye(2))


@pytest.fixture(scope="module")
def design() -> FunnelDesign:
    """The funnel of `caught`."""
    return caught()[1]


def swinging_truth(x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ (N, 2)."""
    return np.stack(swinging(x.T, u.T), axis=1)


def test_a_funnel_of_taylor_models_holds_for_the_true_dynamics(
    design: FunnelDesign, tmp_path: Path
) -> None:
    verdict = check(design.save(tmp_path)[-1])
    assert "keeps x0 in [-0.4003, 0.4003]" in verdict.statement
    assert any("computed by: cubic Taylor models" in text for text in verdict.assumptions)
    assert any("w0 in [-1, 1]" in text for text in verdict.assumptions)
    truth, rng = TrueDynamics(swinging_truth), np.random.default_rng(3)
    run = simulate_boundary(truth, design.policy, design.funnel, starts=3000, rng=rng)
    assert run.violations == 0
    assert VectorField.from_document(design.model.document()).document() == design.model.document()
    for t in design.funnel.t:
        assert np.abs(design.funnel.outline(float(t), (0, 1))[:, 0]).max() <= 0.4 + 1e-3


def test_bounds_of_one_span_do_not_hold_in_another() -> None:
    field, _ = caught()
    assert [j for j, _, _ in field.validity(3)] == [0, 1, 2]
    rows = field.valid.copy()
    rows[rows[:, 3] == 5, 1:3] /= 10
    tight = VectorField(field.pieces, 2, 1, field.breaks, field.uncertain, rows)
    t, x = np.linspace(0, 0.4, 9), np.zeros((9, 2))
    nominal = nominal_through(t, x, np.zeros((9, 1)), tight)
    found = design_funnel(tight, nominal, goal=30 * np.eye(2)).funnel
    for k, most in ((5, 0.0401), (6, 0.0401)):
        assert np.abs(found.outline(float(found.t[k]), (0, 1))[:, 0]).max() <= most
    with pytest.raises(DataError, match="the span where only one is meant"):
        VectorField(field.pieces, 2, 1, field.breaks, field.uncertain, [[0, -1, 1, 8]])  # type: ignore[arg-type]


def test_a_narrower_box_than_the_funnel_needs_is_refused(
    design: FunnelDesign, tmp_path: Path
) -> None:
    files = saved(design, tmp_path)
    for row in files["vector_field.json"]["valid"]:
        if row[3] == 2:
            row[1], row[2] = row[1] / 10, row[2] / 10
    with pytest.raises(CertificateRejected, match="leaves where its dynamics are valid"):
        check(write(files, tmp_path))


def test_a_remainder_made_larger_after_the_fact_is_refused(
    design: FunnelDesign, tmp_path: Path
) -> None:
    files = saved(design, tmp_path)
    equation = files["vector_field.json"]["pieces"][4][1]
    pushes = [row[-1] for row in equation["exponents"]]
    assert sum(pushes) == 1
    equation["coefficients"] = [
        c if not push else c * 2 for c, push in zip(equation["coefficients"], pushes, strict=True)
    ]
    with pytest.raises(CertificateRejected, match="not positive"):
        check(write(files, tmp_path))


def test_the_benchmark_notices_a_remainder_that_is_not_covered() -> None:
    field, _ = caught()
    rng = np.random.default_rng(0)
    assert encloses(field, swinging_truth, rng)
    less = VectorField(field.pieces, 2, 1, field.breaks, 0.03 * field.uncertain, field.valid)
    assert not encloses(less, swinging_truth, rng)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cart_pole", "planar_quadrotor", "pendulum"])
def test_known_problems_are_proved_and_no_start_of_the_true_dynamics_leaves(name: str) -> None:
    _, figures = run(name, starts=5000)
    assert figures["proved"]
    assert figures["remainder_covered"]
    assert figures["violations"] == 0
    assert 0.9 < figures["max_v"] <= 1
