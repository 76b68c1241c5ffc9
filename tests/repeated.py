"""A known monotone system, and noisy repeats of its response."""

from collections.abc import Iterable

import numpy as np

from nlsid import Dataset, Degrees, Trajectory
from nlsid import Polynomial as Equation
from nlsid_core.arrays import FloatArray
from nlsid_core.identification.polynomial.implicit_rie import ImplicitFit, minimise_implicit_rie
from nlsid_core.identification.polynomial.moments import rows_without_bias
from nlsid_core.models import MonotoneEquation, Signal
from nlsid_core.polynomial import Polynomial, constant

NOISE = 0.05
CLASS = Equation(2, (0,), Degrees(left=3), set="3.8")


def truth() -> MonotoneEquation:
    return MonotoneEquation(
        e=np.array([3.0, 0.6, 1.0]),
        a=np.array([1.2, -0.5]),
        b=np.array([1.0]),
        c=0.1,
        window=((0, 0),),
        y_offset=0.0,
        u_offset=np.zeros(1),
        period=0.01,
        y=Signal("y", "m"),
        u=(Signal("u", "V"),),
    )


def run(w: FloatArray, noise: float, seed: int, group: str = "pair") -> Trajectory:
    y = truth().simulate(w) + noise * np.random.default_rng(seed).standard_normal(len(w))
    t = 0.01 * np.arange(len(w))
    return Trajectory(t=t, y=y, u=w, name=f"run {seed}", group=group)


def total(parts: Iterable[Polynomial]) -> Polynomial:
    """Σ parts."""
    result = constant(0.0)
    for part in parts:
        result = result + part
    return result


def pair(samples: int, seed: int, noise: float = NOISE) -> tuple[Trajectory, Trajectory]:
    w = np.random.default_rng(seed).uniform(-2.0, 2.0, samples)
    return run(w, noise, 1000 + seed, f"g{seed}"), run(w, noise, 2000 + seed, f"g{seed}")


def without_bias(*trials: Trajectory) -> ImplicitFit:
    """What `Rie` finds of repeats."""
    return minimise_implicit_rie(rows_without_bias(Dataset(trials), CLASS))


def percent(model: MonotoneEquation, *, seed: int = 99) -> float:
    w = np.random.default_rng(seed).uniform(-2.0, 2.0, 3000)
    y = truth().simulate(w)
    return float(100 * np.linalg.norm(model.simulate(w) - y) / np.linalg.norm(y - y.mean()))
