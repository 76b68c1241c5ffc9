"""A synthetic pair of tanks, one above the other, that flow over: no recorded data.

    h1⁺ = h1 - k1 √h1 + k4 u,                 h1 at most its height;
    h2⁺ = h2 + k2 √h1 - k3 √h2 + overflow,    h2 at most its height; y = h2 + noise,
overflow a share of what the upper tank does not hold. Source of the equations: Schoukens and Noël,
"Three benchmarks addressing open challenges in nonlinear system identification", 2017, Section 3.
"""

import numpy as np

from nlsid_core.data.trajectory import Dataset, Trajectory

SHARE = 0.6
HEIGHT = 10.0
NOISE = 0.02


def tanks(seed: int, samples: int = 1024, h: tuple[float, float] = (4.0, 5.0)) -> Dataset:
    """One trial of levels (volt) every 4 s under a low-passed random pump voltage."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.5, 6.5, samples // 25 + 1), 25)[:samples]
    k1, k2, k3, k4 = 0.45, 0.30, 0.30, 0.30
    upper, lower = h
    y = []
    for pump in u:
        y.append(lower)
        z = upper - k1 * np.sqrt(upper) + k4 * pump
        over = max(z - HEIGHT, 0.0)
        lower += k2 * np.sqrt(upper) - k3 * np.sqrt(lower) + SHARE * over
        upper, lower = max(min(z, HEIGHT), 0.0), max(min(lower, HEIGHT), 0.0)
    measured = np.array(y) + NOISE * rng.standard_normal(samples)
    return Dataset(
        (
            Trajectory(
                t=4.0 * np.arange(samples),
                y=measured[:, None],
                u=u[:, None],
                y_names=("level",),
                u_names=("pump",),
                y_units=("V",),
                u_units=("V",),
                name=f"synthetic tanks {seed}",
            ),
        )
    )
