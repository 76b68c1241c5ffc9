"""Motions near given samples, and how a configuration asks for them."""

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize

from bags.chain.shipped import config_file
from bags.chain.tracking_config import load_tracking_config
from bags.chain.tracking_steps import plan_tracking
from nlsid_core import files
from nlsid_core.design.sampled.motion import (
    NEARNESS,
    RESERVE,
    SMOOTHNESS,
    follow_motion,
    plan_motion,
)
from nlsid_core.errors import DataError, Infeasible, ShapeError
from tests.tracked import PERIOD, pendulum


def swing_config(folder: Path) -> Path:
    """config/pendulum.yaml with samples in the place of its motion's two ends."""
    np.savetxt(folder / "swing.csv", given(), delimiter=",", header="angle,rate", comments="")
    text = config_file("pendulum.yaml").read_text()
    start, end = text.index("  start:"), text.index("  input_weight:")
    path = folder / "swing.yaml"
    path.write_text(text[:start] + "  samples: swing.csv\n" + text[end:])
    return path


def given(height: float = 0.4, seconds: float = 1.6) -> np.ndarray:
    """Out and back, at rest at both ends."""
    t = np.arange(round(seconds / PERIOD) + 1) * PERIOD
    phase = 2 * np.pi * t / seconds
    rate = height * np.pi / seconds * np.sin(phase)
    return np.stack([height / 2 * (1 - np.cos(phase)), rate], axis=1)


def test_given_samples_become_a_motion_of_the_model_itself() -> None:
    model, samples = pendulum(), given()
    x, u = follow_motion(model, samples)
    np.testing.assert_allclose(x[1:], model(x[:-1], u), rtol=0, atol=1e-15)
    np.testing.assert_allclose(x, samples, atol=0.02)
    np.testing.assert_allclose(x[[0, -1]], samples[[0, -1]], atol=1e-5)
    assert (np.abs(u) < 9.0).all()  # a tenth of the box is kept in reserve


def test_a_planned_motion_is_the_one_that_scipy_finds_more_slowly() -> None:
    """The same transcription of 15 samples by SLSQP, in units of the box."""
    model, steps = pendulum(), 15
    half_x, half_u = model.x_range[:, 1], model.u_range[:, 1]
    ends = np.array([[0.0, 0.0], [0.1, 0.0]]) / half_x

    def parts(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return z[: 2 * (steps + 1)].reshape(-1, 2), z[2 * (steps + 1) :].reshape(-1, 1)

    def cost(z: np.ndarray) -> float:
        x, u = parts(z)
        smooth = SMOOTHNESS * steps * float(np.sum(np.diff(u, axis=0) ** 2))
        return (NEARNESS * float(np.sum(x**2)) + float(np.sum(u**2)) + smooth) / 2

    def defects(z: np.ndarray) -> np.ndarray:
        x, u = parts(z)
        steps_missed = model(x[:-1] * half_x, u * half_u) / half_x - x[1:]
        return np.concatenate([steps_missed.ravel(), x[0] - ends[0], x[-1] - ends[1]])

    start = np.zeros(3 * steps + 2)
    found = minimize(
        cost,
        start,
        method="SLSQP",
        constraints={"type": "eq", "fun": defects},
        bounds=[(-1.0 + RESERVE, 1.0 - RESERVE)] * len(start),
        options={"maxiter": 300},
    )
    assert found.success
    x, u = plan_motion(model, [0.0, 0.0], [0.1, 0.0], steps=steps)
    ours = np.concatenate([(x / half_x).ravel(), (u / half_u).ravel()])
    assert cost(ours) <= found.fun * (1 + 1e-5)
    np.testing.assert_allclose(ours, found.x, atol=2e-3)


def test_samples_that_are_no_motion_within_the_inputs_are_infeasible() -> None:
    model = pendulum()
    with pytest.raises(Infeasible, match="out of reach"):
        follow_motion(model, given(height=1.0, seconds=0.2)[:6])


@pytest.mark.parametrize(
    ("samples", "error", "said"),
    [
        (np.zeros((5, 3)), ShapeError, "should be"),
        (np.full((5, 2), np.nan), DataError, "NaN"),
        (np.array([[0.0, 0.0], [1.5, 0.0]]), DataError, "outside"),
    ],
)
def test_samples_that_cannot_be_followed_say_why(
    samples: np.ndarray, error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        follow_motion(pendulum(), samples)


def test_a_configuration_takes_its_samples_from_a_file_beside_it(tmp_path: Path) -> None:
    config = load_tracking_config(swing_config(tmp_path))
    assert config.motion.samples == tmp_path / "swing.csv"
    files.write_document(tmp_path / "model.json", pendulum().document())
    policy = plan_tracking(tmp_path / "model.json", config, tmp_path)
    assert len(policy) == len(given()) - 1
    np.testing.assert_allclose(policy.x, given(), atol=0.02)


@pytest.mark.parametrize(
    ("text", "said"), [("rate,angle\n0,0\n", "angle,rate"), ("angle,rate\n0,x\n", "could not")]
)
def test_a_file_of_samples_that_is_wrong_is_an_error_that_names_it(
    tmp_path: Path, text: str, said: str
) -> None:
    config = load_tracking_config(swing_config(tmp_path))
    (tmp_path / "swing.csv").write_text(text)
    files.write_document(tmp_path / "model.json", pendulum().document())
    with pytest.raises(DataError, match=rf"swing\.csv.*{said}"):
        plan_tracking(tmp_path / "model.json", config, tmp_path)


@pytest.mark.parametrize("extra", ["  start: [0.0, 0.0]\n", None])
def test_a_motion_is_either_samples_or_two_ends(tmp_path: Path, extra: str | None) -> None:
    path = swing_config(tmp_path)
    text = path.read_text()
    line = "  samples: swing.csv\n"
    path.write_text(text.replace(line, line + extra if extra else ""))
    with pytest.raises(DataError, match="samples"):
        load_tracking_config(path)
