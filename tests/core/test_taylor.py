"""Taylor models enclose what they stand for, and funnels of them hold for the true dynamics."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.thesis.soundness import Simulation, TrueDynamics
from examples import cart_pole, planar_quadrotor, torque_limited_pendulum
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, FunnelDesign, design_funnel, nominal_through
from nlsid_core.dynamics import Rates, VectorField, solve, taylor_field
from nlsid_core.errors import DataError, NlsidError, ShapeError
from nlsid_core.polynomial import Polynomial
from nlsid_core.proofs import check
from tests.core.kernel import refusals
from tests.edits import scaled
from tests.funnel_files import FIELD, files_of, forged_by
from tests.marks import slow_among


def swinging(x: Any, u: Any) -> list[Any]:
    """A pendulum whose drive depends on its angle."""
    return [x[1], -9.81 * np.sin(x[0]) + u[0] / (2 + np.cos(x[0])) - x[1] * x[1] / 10]


def expanded(
    function: Any,
    centre: Any,
    radius: Any,
    *,
    states: int,
    uncertain: Any = None,
    affine: bool = False,
) -> tuple[list[Polynomial], FloatArray]:
    """Cubics in t, x, u, w on a box of (x, u), from t = 0 to 0.1, and the bounds of the rest."""
    centre, radius = np.asarray(centre, float), np.asarray(radius, float)
    rates = Rates.of(function, states, len(centre) - states, uncertain, affine=affine)
    found, bounds = rates.on(centre - radius, centre + radius, (0.0, 0.1)).equations
    return list(found), bounds


def left_over(
    function: Any, cubics: list[Polynomial], box: FloatArray, states: int, inputs: int
) -> FloatArray:
    """(n,) the most that the cubics leave out, at random points and corners of box (k, 2)."""
    rng = np.random.default_rng(0)
    shares = np.vstack([rng.uniform(0, 1, (3000, len(box))), rng.integers(0, 2, (200, len(box)))])
    points = box[:, 0] + shares * (box[:, 1] - box[:, 0])
    rates = Rates(function, states, inputs, np.zeros((len(box) - 1 - states - inputs, 2)), (), ())
    end = 1 + states + inputs
    true = [rates(p[0], p[1 : 1 + states], p[1 + states : end], p[end:])[0] for p in points]
    return np.asarray(
        np.abs(np.array(true) - np.stack([c.rounded()(points) for c in cubics], axis=1)).max(axis=0)
    )


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (2.5, -3.0, 4.0), (-1.25, 0.5, -2.0)])
@pytest.mark.parametrize("size", [0.01, 0.3, 1.0])
def test_the_remainder_is_never_more_than_its_bound_and_in_small_boxes_not_much_less(
    centre: tuple[float, ...], size: float
) -> None:
    radius = size * np.array([1.0, 2.0, 3.0])
    cubics, bounds = expanded(swinging, centre, radius, states=2)
    box = np.stack([np.array(centre) - radius, np.array(centre) + radius], axis=1)
    left = left_over(swinging, cubics, np.vstack([[0.0, 0.1], box]), 2, 1)
    rounding = 1e-13 * (1 + np.abs(centre).max()) * 10
    assert (left <= bounds + rounding).all()
    assert bounds[0] == 0
    if size < 1:  # in a wide box a division's series leaves much more than it has to
        assert bounds[1] <= 20 * left[1] + rounding


@pytest.mark.parametrize("centre", [(0.0, 9.81, 0.0), (0.4, -2.0, -0.3)])
def test_cubics_that_are_affine_in_each_input_count_its_squares_in_the_remainder(
    centre: tuple[float, ...],
) -> None:
    radius = np.array([0.2, 1.0, 0.3])
    box = np.stack([np.array(centre) - radius, np.array(centre) + radius], axis=1)
    for function in (
        lambda x, u: [x[0] * u[1] ** 2 + u[1] ** 3 + u[0] * u[1]],
        lambda x, u: [u[0] * np.sin(x[0] + u[1])],
    ):
        free, _ = expanded(function, centre, radius, states=1)
        assert (free[0].exponents[:, 2:4] > 1).any(), "else nothing is left out here"
        cubics, bounds = expanded(function, centre, radius, states=1, affine=True)
        assert (cubics[0].exponents[:, 2:4] <= 1).all()
        left = left_over(function, cubics, np.vstack([[0.0, 0.1], box]), 1, 2)
        assert 0 < left[0] <= bounds[0] <= 3 * left[0]


def test_one_over_something_that_may_be_zero_is_refused() -> None:
    with pytest.raises(DataError, match="may be zero in the box"):
        expanded(lambda x, u: [u[0] / x[0]], [0.5, 0.0], [0.5, 1.0], states=1)
    with pytest.raises(ShapeError, match="1 rates for 2 states"):
        expanded(lambda x, u: [x[0] + u[0]], [0.5, 0.0, 0.0], [0.5, 1.0, 1.0], states=2)


EVERYTHING: dict[str, Any] = {
    "numbers": lambda x, u: [3 - x[0] / 3 + u[0] ** 2 + np.sin(x[0]) * 0],
    "division": lambda x, u: [1 / (4 - x[0]) - u[0] / -(3 + x[0])],
    "powers": lambda x, u: [-(x[0] ** 3) * u[0] + x[0] ** 7 - (2 + x[0]) ** -2],
    "roots": lambda x, u: [np.sqrt(2 + x[0] * u[0]) + (3 + u[0]) ** 0.5 + (3 + x[0]) ** -0.5],
    "squares": lambda x, u: [
        np.sqrt(x[0] ** 2 - x[0] + 0.4) + 1 / (u[0] ** 2 + 0.3 - x[0] ** 2 / 9)
    ],
    "tan": lambda x, u: [np.tan(x[0] / 2) - np.tan(3 + u[0] / 4)],
    "exp": lambda x, u: [np.exp(-x[0] * u[0]) + np.log(2 + x[0])],
    "tanh": lambda x, u: [np.tanh(3 * x[0]) - np.arctan(u[0] + 2 * x[0])],
    "arctan2": lambda x, u: [np.arctan2(x[0] + 1, u[0] - 1.5) + np.arctan2(u[0] - 3, x[0] / 4)],
    "abs": lambda x, u: [abs(u[0]) + np.abs(x[0]) - abs(x[0] - u[0] - 5)],
    "solve": lambda x, u: [solve([[0.2 * x[0], 2 + u[0]], [3, x[0]]], [np.cos(x[0]), u[0]])[0]],
    "arrays": lambda x, u: [np.cross([x[0], u[0], 1.0], [np.sin(x[0]), 2, x[0] * u[0]])[2]],
}


@pytest.mark.parametrize("name", EVERYTHING)
@pytest.mark.parametrize("size", slow_among([0.05, 0.5], {0.05}))
def test_every_operation_encloses(name: str, size: float) -> None:
    centre, radius = np.array([1.0, -0.5]), size * np.array([1.0, 1.5])
    cubics, bounds = expanded(EVERYTHING[name], centre, radius, states=1)
    box = np.array([[0.0, 0.1], *np.stack([centre - radius, centre + radius], axis=1)])
    left = left_over(EVERYTHING[name], cubics, box, 1, 1)
    assert left[0] <= bounds[0] + 1e-13
    if size < 0.1:
        assert bounds[0] < 0.02


def test_a_square_is_not_taken_to_be_negative() -> None:
    for drag in (
        lambda x, u: [u[0] - x[0] * np.sqrt(x[0] ** 2 + 0.25)],
        lambda x, u: [u[0] - x[0] / (0.25 + x[0] ** 2)],
        lambda x, u: [u[0] - np.log(0.25 + (x[0] - 0.3) ** 2)],
    ):
        centre, radius = np.array([0.1, 0.0]), np.array([0.7, 1.0])
        cubics, bounds = expanded(drag, centre, radius, states=1)
        box = np.array([[0.0, 0.1], *np.stack([centre - radius, centre + radius], axis=1)])
        left = left_over(drag, cubics, box, 1, 1)
        assert left[0] <= bounds[0], "x0² + 1/4 is no less than 1/4"


def test_time_and_disturbances_are_expanded_too() -> None:
    def blown(t: Any, x: Any, u: Any, w: Any) -> Any:
        return [x[1] + w[0], np.sin(x[0] + 3 * t) + 0.3 * w[1] + w[0] * np.cos(x[0]) + u[0]]

    centre, radius, w = np.array([0.4, 0.1, 0.0]), np.full(3, 0.2), [[-0.1, 0.3], [-1.0, 1.0]]
    cubics, bounds = expanded(blown, centre, radius, states=2, uncertain=w)
    box = np.array([[0.0, 0.1], *np.stack([centre - radius, centre + radius], axis=1), *w])
    assert (left_over(blown, cubics, box, 2, 1) <= bounds + 1e-13).all()
    assert bounds[0] == 0
    assert 0 < bounds[1] < 0.01
    t = np.linspace(0, 1, 5)
    field = taylor_field(
        blown, t, np.zeros((5, 2)), np.zeros((5, 1)), radius=[1, 1, 1], uncertain=w
    )
    assert field.uncertain.tolist() == [[-0.1, 0.3], [-1.0, 1.0], [-1.0, 1.0]]


def test_many_inexact_rates_are_pushes_and_exact_ones_have_none() -> None:
    n = 14
    t, x = np.linspace(0, 1, 3), np.zeros((3, n))
    field = taylor_field(
        lambda x: [*np.sin(x[: n - 2]), x[0] / 3 + 0.1 * x[1] + 0.2 * x[1], x[3] ** 3],
        t,
        x,
        np.zeros((3, 0)),
        radius=np.full(n, 0.1),
    )
    assert len(field.uncertain) == n - 2
    assert field.is_pushed


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda x: [np.arcsin(x[0])], "arcsin.*known are .*np.arctan2.*dynamics.solve"),
        (lambda x, u: [x[0] if x[0] > 0 else u[0]], "comparison: which branch"),
        (lambda x, u: [np.linalg.solve([[x[0]]], [u[0]])[0]], "known are"),
        (lambda x: [np.sin(x[0]) ** 0.3], "power 0.3: whole numbers"),
        (lambda x, u: [np.arctan2(x[0] - 1, u[0])], "zero in the box"),
        (lambda x: [np.log(x[0] - 1)], "logarithm of a value that may not be positive"),
        (lambda x: [np.tan(x[0] + 0.57)], "may be at a pole"),
        (lambda x, v: [x[0] + v], "function of some of t, x, u, w"),
        (lambda x, w: [x[0] + w[0]], "give its bounds as `uncertain`"),
    ],
)
def test_what_is_not_supported_says_what_is(function: Any, said: str) -> None:
    with pytest.raises(NlsidError, match=said):
        expanded(function, [1.0, -0.5], [0.5, 0.75], states=1)


def test_arguments_with_a_default_keep_it() -> None:
    def damped(x: Any, g: float = 9.81, *, u: Any, damping: float = 0.5) -> list[Any]:
        return [x[1], -g * np.sin(x[0]) - damping * x[1] + u[0]]

    def plain(x: Any, u: Any) -> list[Any]:
        return [x[1], -9.81 * np.sin(x[0]) - 0.5 * x[1] + u[0]]

    box = [1.0, -0.5, 0.0], [0.5, 0.75, 1.0]
    (found, bounds), (wanted, same) = (expanded(f, *box, states=2) for f in (damped, plain))
    for got, expected in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(got.exponents, expected.exponents)
        np.testing.assert_array_equal(got.coefficients, expected.coefficients)
    np.testing.assert_array_equal(bounds, same)

    def falling(x: Any, rate: float = 2.0) -> list[Any]:
        return [-rate * x[0]]

    assert VectorField.from_function(falling, 1, 0)(0.0, [[3.0]], [[]]).tolist() == [[-6.0]]
    twice = partial(falling, rate=4.0)
    assert VectorField.from_function(twice, 1, 0)(0.0, [[3.0]], [[]]).tolist() == [[-12.0]]


def test_a_radius_that_makes_no_sense_is_refused() -> None:
    t, x, u = np.linspace(0, 1, 3), np.zeros((3, 2)), np.zeros((3, 1))
    with pytest.raises(DataError, match=r"how far .* may be, 0 or more"):
        taylor_field(swinging, t, x, u, radius=[-0.1, 1, 1])
    with pytest.raises(ShapeError, match="radius should have 3 entries"):
        taylor_field(swinging, t, x, u, radius=[0.1, 1])
    with pytest.raises(ShapeError, match="a motion should be"):
        taylor_field(swinging, t, x, u[:, 0], radius=[0.1, 1, 1])


# -- funnels -----------------------------------------------------------------------------------


def caught() -> tuple[VectorField, FunnelDesign]:
    """The pendulum above, brought to rest in 0.4 s, cubic models of 8 intervals."""
    t = np.linspace(0, 0.4, 9)
    x = np.zeros((9, 2))
    field = taylor_field(swinging, t, x, np.zeros((9, 1)), radius=[0.4, 3.0, 30.0])
    nominal = nominal_through(t, x, np.zeros((9, 1)), field)
    return field, design_funnel(ContinuousTracking(field, nominal, goal=30 * np.eye(2)))


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
    assert "keeps x0 in [-0.4001, 0.4001]" in verdict.statement
    assert any('computed by: "cubic Taylor models' in text for text in verdict.assumptions)
    assert any("w0 in [-1, 1]" in text for text in verdict.assumptions)
    truth, rng = TrueDynamics(swinging_truth), np.random.default_rng(3)
    run = Simulation(truth, design.policy, design.funnel).boundary(starts=3000, rng=rng)
    assert run.violations == 0
    assert VectorField.from_document(design.model.document()).document() == design.model.document()
    for t in design.funnel.t:
        assert np.abs(design.funnel.outline(float(t), (0, 1))[:, 0]).max() <= 0.4 + 1e-3


@pytest.mark.slow
def test_bounds_of_one_span_do_not_hold_in_another() -> None:
    field, _ = caught()
    assert [j for j, _, _ in field.validity(3)] == [0, 1, 2]
    rows = field.valid.copy()
    rows[rows[:, 3] == 5, 1:3] /= 10
    tight = VectorField(field.pieces, 2, 1, field.breaks, field.uncertain, rows)
    t, x = np.linspace(0, 0.4, 9), np.zeros((9, 2))
    nominal = nominal_through(t, x, np.zeros((9, 1)), tight)
    found = design_funnel(ContinuousTracking(tight, nominal, goal=30 * np.eye(2))).funnel
    for k, most in ((5, 0.0401), (6, 0.0401)):
        assert np.abs(found.outline(float(found.t[k]), (0, 1))[:, 0]).max() <= most
    with pytest.raises(DataError, match="the span where only one is meant"):
        VectorField(field.pieces, 2, 1, field.breaks, field.uncertain, [[0, -1, 1, 8]])  # type: ignore[arg-type]


def test_a_narrower_box_than_the_funnel_needs_is_refused(design: FunnelDesign) -> None:
    files = files_of(design)
    for row in files[FIELD]["valid"]:
        if row[3] == 2:
            row[1], row[2] = row[1] / 10, row[2] / 10
    refusals.refused_with_fresh_digests(files, "not_valid")


def test_a_remainder_made_larger_after_the_fact_is_refused(design: FunnelDesign) -> None:
    files = files_of(design)
    equation = files[FIELD]["pieces"][4][1]
    pushes = [row[-1] for row in equation["exponents"]]
    larger = scaled(f"{FIELD} pieces 4 1 coefficients {pushes.index(1)}", 100.0)
    assert sum(pushes) == 1
    refusals.refused_with_fresh_digests(forged_by(larger, files), "not_positive")


def encloses(field: VectorField, truth: Any) -> bool:
    """Whether, at random points of the boxes where it is valid, the field with some w in its box is
    the truth, up to rounding."""
    rng, times = np.random.default_rng(0), np.r_[-np.inf, field.breaks]
    for span in range(len(field.pieces)):
        bounds = {j: (low, high) for j, low, high in field.validity(span)}
        box = np.array([bounds.get(j, (-20.0, 20.0)) for j in range(field.n + field.m)])
        X, U = np.split(rng.uniform(box[:, 0], box[:, 1], size=(2000, len(box))), [field.n], axis=1)
        t = float(times[span]) if span else 0.0
        rates = np.array([field(t, X, U, w, span=span) for w in field.vertices()])
        true = truth(X, U)
        room = 1e-9 * (1 + np.abs(true))
        if (true < rates.min(axis=0) - room).any() or (true > rates.max(axis=0) + room).any():
            return False
    return True


def test_a_remainder_that_is_not_covered_is_seen() -> None:
    field, _ = caught()
    assert encloses(field, swinging_truth)
    less = VectorField(field.pieces, 2, 1, field.breaks, 0.03 * field.uncertain, field.valid)
    assert not encloses(less, swinging_truth)


@pytest.mark.slow
@pytest.mark.parametrize("example", [cart_pole, planar_quadrotor, torque_limited_pendulum])
def test_known_problems_are_proved_and_no_start_of_the_true_dynamics_leaves(
    example: Any, tmp_path: Path
) -> None:
    design = example.designed()
    check(design.save(tmp_path)[-1])
    assert encloses(design.model, example.truth)
    followed = Simulation(TrueDynamics(example.truth), design.policy, design.funnel).boundary(
        starts=5000, rng=np.random.default_rng(21), substeps=10
    )
    assert followed.violations == 0
    assert 0.9 < followed.max_v <= 1
