"""One home for the nouns, what funnels of every kind share, and one `load` for all files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import files
from nlsid_core.design import OutputTubeDesign
from nlsid_core.documents import load
from nlsid_core.dynamics import VectorField, constant_on, cubic_through, linear_through
from nlsid_core.errors import DataError, DocumentError, ShapeError
from nlsid_core.funnels import (
    ContinuousFunnel,
    DisturbanceAssumption,
    Measured,
    SampledFunnel,
    Tube,
    TubeFunnel,
    ellipsoid_inside,
)
from nlsid_core.policies import ContinuousPolicy, SampledPolicy, TubePolicy
from tests.continuous_stage import stage
from tests.tracked import designed


def random_funnel(n: int = 3, knots: int = 6) -> ContinuousFunnel:
    """A funnel with nothing round about it."""
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.1, 1, knots))
    x = cubic_through(t, rng.normal(size=(knots, n)), rng.normal(size=(knots, n)))
    roots = rng.normal(size=(knots, n, n))
    P = roots @ roots.transpose(0, 2, 1) + np.eye(n)
    return ContinuousFunnel(
        x, (P + P.transpose(0, 2, 1)) / 2, rng.uniform(0.1, 2, knots), "field", "policy"
    )


def random_policy(gain: str, n: int = 3, m: int = 2, knots: int = 6) -> ContinuousPolicy:
    rng = np.random.default_rng(6)
    x = random_funnel(n, knots).x
    K = rng.normal(size=(knots, m, n))
    pieces = {
        "constant": constant_on(x.t, K[1:]),
        "linear": linear_through(x.t, K),
        "cubic": cubic_through(x.t, K, rng.normal(size=K.shape)),
    }
    return ContinuousPolicy(
        x, linear_through(x.t, rng.normal(size=(knots, m))), pieces[gain], "field"
    )


def discrete_documents() -> dict[str, Any]:
    """The other kinds of funnels and policies."""
    two = np.array([np.eye(2)] * 3)
    ones, trial = np.ones(1), (("trial", "sha256:1"),)
    scaled = Measured(1.0, 2.0, (), trial)
    tube = Tube(0.5, np.ones((2, 1)), np.eye(2), np.eye(1), ones, ones, 4.0, scaled)
    return {
        "discrete": SampledFunnel(
            two,
            two[:2],
            np.ones(3),
            np.ones(3),
            np.ones((3, 2)),
            DisturbanceAssumption(0.2, 0.1, 2.0, (("run", "sha256:0"),)),
            "m",
            "p",
        ),
        "tube": TubeFunnel((tube,), 2, "m", policy="p"),
        "tracking": SampledPolicy(
            np.zeros((3, 2)), np.zeros((2, 1)), np.zeros((2, 1, 2)), np.eye(2), 0.1, "m"
        ),
        "tube_policy": TubePolicy(np.zeros(2), np.zeros(3), np.zeros(2), np.ones(2), 0.1, "m"),
    }


def test_a_funnel_reads_back_bit_for_bit_with_every_promised_name(tmp_path: Path) -> None:
    funnel = random_funnel()
    files.write_document(tmp_path / "funnel.json", funnel.document())
    again = ContinuousFunnel.from_document(files.load_document(tmp_path / "funnel.json"))
    assert again.document() == funnel.document()
    assert (again.t0, again.tf) == (funnel.x.t[0], funnel.x.t[-1])
    rng = np.random.default_rng(7)
    for t in rng.uniform(funnel.t0, funnel.tf, 20).tolist():
        X = rng.normal(size=(9, 3))
        assert again.nominal(t).shape == (3,)
        assert again.value(t, X).shape == (9,)
        assert (again.value(t, X) == funnel.value(t, X)).all()
        assert again.value(t, again.nominal(t)[None])[0] == 0
        assert again.volume(t) == funnel.volume(t) > 0


def test_the_boundary_is_where_the_value_is_1_at_many_times() -> None:
    funnel, rng = random_funnel(), np.random.default_rng(8)
    for t in rng.uniform(funnel.t0, funnel.tf, 10).tolist():
        X = rng.normal(size=(50, 3))
        inside = funnel.boundary(t, X / np.linalg.norm(X, axis=1)[:, None])
        assert funnel.value(t, inside) == pytest.approx(np.ones(50))


def test_the_volume_is_the_share_of_random_points_inside() -> None:
    funnel, rng = random_funnel(), np.random.default_rng(9)
    t = (funnel.t0 + funnel.tf) / 2
    half = np.sqrt(np.diag(np.linalg.inv(funnel.shape(t))))
    X = funnel.nominal(t) + rng.uniform(-1, 1, size=(200_000, 3)) * half
    share = (funnel.value(t, X) <= 1).mean()
    assert funnel.volume(t) == pytest.approx(share * np.prod(2 * half), rel=0.01)


@pytest.mark.parametrize("axes", [(0, 1), (2, 0)])
def test_an_outline_is_the_tightest_shadow(axes: tuple[int, int]) -> None:
    funnel, rng = random_funnel(4), np.random.default_rng(10)
    t = funnel.t0 + 0.3
    directions = rng.normal(size=(20_000, 4))
    boundary = funnel.boundary(t, directions / np.linalg.norm(directions, axis=1)[:, None])
    outline = funnel.outline(t, axes, points=60)
    for direction in rng.normal(size=(20, len(axes))):
        reach = (outline @ direction).max() - funnel.nominal(t)[list(axes)] @ direction
        shadow = (boundary[:, list(axes)] @ direction).max() - funnel.nominal(t)[list(axes)] @ (
            direction
        )
        assert reach == pytest.approx(shadow, rel=0.05)


def test_an_ellipsoid_is_inside_exactly_up_to_the_boundary() -> None:
    funnel = random_funnel()
    t = funnel.t0 + 0.5
    shape, centre = funnel.shape(t), funnel.nominal(t)
    for scale, inside in ((1.001, True), (0.999, False)):
        assert inside is (ellipsoid_inside(centre, scale * shape, centre, shape) is not None)


@pytest.mark.parametrize("gain", ["constant", "linear", "cubic"])
def test_a_policy_of_every_kind_of_gain_reads_back_and_takes_many_states(
    gain: str, tmp_path: Path
) -> None:
    policy = random_policy(gain)
    files.write_document(tmp_path / "policy.json", policy.document())
    again = ContinuousPolicy.from_document(files.load_document(tmp_path / "policy.json"))
    assert again.document() == policy.document()
    t, X = 0.4 * policy.t[0] + 0.6 * policy.t[1], np.random.default_rng(1).normal(size=(7, 3))
    u = again(float(t), X)
    assert u.shape == (7, 2)
    assert u[3] == pytest.approx(policy.u(t) - policy.K(t) @ (X[3] - policy.x(t)))
    middle = policy.K(t)
    ends = policy.K.control[0, 0], policy.K.control[0, -1]
    if gain == "constant":
        assert (middle == ends[0]).all()
    elif gain == "linear":
        assert middle == pytest.approx(0.4 * ends[0] + 0.6 * ends[1])
    else:
        assert policy.K.degree == 3


def test_load_reads_whatever_the_file_declares(tmp_path: Path) -> None:
    nouns: dict[str, Any] = {
        "funnel": random_funnel(),
        "policy": random_policy("linear"),
        "field": VectorField.from_function(lambda x: np.array([-x[0]]), 1, 0),
    }
    for name, noun in (nouns | discrete_documents()).items():
        files.write_document(tmp_path / name, noun.document())
        again = load(tmp_path / name)
        assert type(again) is type(noun)
        assert again.document() == noun.document()


def test_a_file_of_another_kind_is_named(tmp_path: Path) -> None:
    discrete = discrete_documents()["discrete"].document()
    files.write_document(tmp_path / "funnel.json", discrete)
    with pytest.raises(DocumentError, match="kind is 'sampled', expected 'continuous'"):
        ContinuousFunnel.from_document(files.load_document(tmp_path / "funnel.json"))
    files.write_document(tmp_path / "odd.json", discrete | {"kind": "odd"})
    with pytest.raises(DocumentError, match="no 'nlsid/funnel' of kind 'odd' is known"):
        load(tmp_path / "odd.json")


def test_outside_its_times_a_funnel_says_so() -> None:
    funnel = random_funnel()
    with pytest.raises(DataError, match="the funnel is defined from"):
        funnel.value(funnel.tf + 1e-6, np.zeros((1, 3)))
    with pytest.raises(ShapeError, match=r"should have shape \(N, 3\)"):
        funnel.value(funnel.t0, np.zeros(3))


# -- What funnels and policies of every kind have in common: sizes, widths, one `load` each


def pairs() -> list[tuple[Any, Any]]:
    """One of each kind that holds a state."""
    sampled, (_, policy, funnel) = designed(), stage()
    return [(sampled.policy, sampled.funnel), (policy, funnel)]


def test_every_kind_answers_the_same_questions(design: OutputTubeDesign) -> None:
    for plan, common in pairs():
        for when in (0, common.last):
            widths = common.widths(when)
            assert common.size(when, np.zeros(len(widths))) <= 1e-12
            assert not common.size(when, np.full(len(widths), np.nan)) <= 1.0
            for i, width in enumerate(widths):
                inside = np.zeros(len(widths))
                inside[i] = width
                assert common.size(when, 1.001 * inside) > 1.0, "beyond its width on an axis"
        assert common.made_for == (plan.made_for, files.digest(plan.document()))
        _covers(plan, len(common.widths(0)))
        assert plan.last <= common.last
    assert design.policy is not None
    tube, planned = design.funnel, design.policy.plan(design.model)
    assert tube.made_for == (design.policy.made_for, files.digest(design.policy.document()))
    _covers(planned, len(design.model))
    assert planned.last <= tube.last
    assert tube.start_size(np.zeros(len(design.model))) == 0.0
    assert not tube.start_size(np.full(len(design.model), np.nan)) <= 1.0


def _covers(plan: Any, n: int) -> None:
    low, high = plan.covers(0, np.zeros(n))
    assert np.all(low <= high)
