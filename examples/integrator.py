"""A position that adds up its command for ever: a cart under a force, on a slope nobody knows.

v⁺ = 0.95 v + 0.02 (u + slope), p⁺ = p + 0.05 v; p is measured with 1 mm of noise. No stable model
has p as its output. Washed out over 2 s, p is the output of one; its proved tube says how far the
cart can be, 2 s on, from where the model says. The same from its velocity is wider.
"""

from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from bags.designs.displacement import displacement_half_width
from bags.signals.expressions import Expression
from nlsid import Dataset, OutputTube, Polynomial, Trajectory, design, identify
from nlsid_core.arrays import FloatArray
from nlsid_core.design import OutputTubeDesign
from nlsid_core.identification.prediction import simulate_trial

PERIOD, SPAN = 0.05, 2.0  # s
SAMPLES, LAGS = 400, 3
NOISE = 0.001  # m


@dataclass(frozen=True)
class Drive:
    """One drive: times (N,) s, force (N,) N and measured position (N,) m."""

    t: FloatArray
    force: FloatArray
    position: FloatArray

    def trial(self, y: FloatArray) -> Trajectory:
        """The drive with `y` (N,) made of its position as the response."""
        digest = sha256(self.position.tobytes()).hexdigest()
        name = digest[:8]
        return Trajectory(t=self.t, y=y, u=self.force, name=name, digest=f"sha256:{digest}")

    def washed_out(self) -> Trajectory:
        """`|washout(2 s)` of its position."""
        moved = Expression.parse(f"/car:position|washout({SPAN:g} s)")
        return self.trial(moved.apply(self.position, np.rint(1e9 * self.t).astype(np.int64), "m"))

    def velocity(self) -> Trajectory:
        """The differences of its position, the sum of which is the position again."""
        return self.trial(np.diff(self.position, prepend=self.position[0]) / PERIOD)


def drive(rng: np.random.Generator) -> Drive:
    """The cart under forces that are held for a second, on a slope of its own."""
    force = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // 20), 20)
    slope, p, v = rng.uniform(-0.02, 0.02), 0.0, 0.0
    positions = []
    for u in force:
        positions.append(p)
        p, v = p + PERIOD * v, 0.95 * v + 0.02 * (u + slope)
    noise = NOISE * rng.standard_normal(SAMPLES)
    return Drive(PERIOD * np.arange(SAMPLES), force, np.array(positions) + noise)


def designed(drives: list[Drive], *, velocity: bool = False) -> OutputTubeDesign:
    """The proved tube: half of the drives make the model and the observer, the others its level."""
    trials = [one.velocity() if velocity else one.washed_out() for one in drives]
    train, calibration = Dataset(tuple(trials[::2])), Dataset(tuple(trials[1::2]))
    model = identify(train, Polynomial(LAGS)).model
    return design(OutputTube(model, train, calibration, level="constant"))


def simulated(design: OutputTubeDesign, one: Drive) -> FloatArray:
    """(N,) m: the position that the simulated q says, but for a constant, step by step."""
    q = simulate_trial(design.model, one.washed_out())[:, 0]
    return np.cumsum(np.diff(q, prepend=0.0) + (1.0 - np.exp(-PERIOD / SPAN)) * np.r_[0.0, q[:-1]])


def off(design: OutputTubeDesign, one: Drive) -> float:
    """The largest error in m of a simulated displacement over at most SPAN, by brute force."""
    wrong = (one.position - simulated(design, one))[LAGS:]
    spans = range(1, round(SPAN / PERIOD) + 1)
    return max(float(np.abs(wrong[k:] - wrong[:-k]).max()) for k in spans)


def draw(path: Path) -> None:
    """The worst of 20 new drives, simulated for SPAN at a time, and the errors in their bound."""
    from matplotlib.figure import Figure

    rng = np.random.default_rng(17)
    tube = designed([drive(rng) for _ in range(24)])
    one = max((drive(rng) for _ in range(20)), key=partial(off, tube))
    samples = round(SPAN / PERIOD)
    moved, width = simulated(tube, one), float(tube.funnel.half_widths[0])
    figure = Figure(figsize=(8, 4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(one.t, one.position, color="#9aa0a6", lw=3.0, label="measured")
    for begin in range(LAGS, SAMPLES, samples):
        rows = slice(begin, begin + samples)
        p = one.position[begin] + moved[rows] - moved[begin]
        bound = 1000 * width * (2.0 + (one.t[rows] - one.t[begin]) / SPAN)
        first = begin == LAGS
        above.plot(
            one.t[rows],
            p,
            color="#1f6fb4",
            lw=1.2,
            label=f"simulated, {SPAN:g} s at a time" if first else None,
        )
        below.plot(one.t[rows], 1000 * (one.position[rows] - p), color="#1f6fb4", lw=1.2)
        below.fill_between(
            one.t[rows],
            -bound,
            bound,
            color="#1f6fb4",
            alpha=0.2,
            lw=0,
            label="bound by the proved tube" if first else None,
        )
    above.set_ylabel("position [m]")
    above.legend(loc="upper left", frameon=False)
    below.legend(loc="upper right", frameon=False, ncols=2)
    below.set(xlabel="t [s]", ylabel="off [mm]")
    figure.savefig(path, dpi=110)


def run() -> tuple[dict[str, float], dict[str, float]]:
    """(computed, bounds in m): how far displacements over 2 s are from the simulated ones."""
    rng = np.random.default_rng(17)
    drives = [drive(rng) for _ in range(24)]
    tube = designed(drives)
    span = Fraction(SPAN)
    bound = displacement_half_width(float(tube.funnel.half_widths[0]), span, span)
    of_velocity = SPAN * float(designed(drives, velocity=True).funnel.half_widths[0])
    worst = max(off(tube, drive(rng)) for _ in range(100))
    return {"100 new drives": worst}, {"washed out": float(bound), "velocity": of_velocity}


if __name__ == "__main__":
    print(*run(), sep="\n")
