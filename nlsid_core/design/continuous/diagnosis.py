"""Why there is no funnel at an instant: what lets V fall there, and what takes it away.

The dual solution of an L-step weighs the boundary's points so that the weighted mean of -Ẇ/ρ is
the largest margin there is. -Ẇ/ρ is a sum of terms, so each term's weighted mean is its share.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.lstep import LSteps, Section
from nlsid_core.errors import Infeasible, SolverError

NOISE = 1e-6  # of the linear part: less is rounding
CLOSE = 1e-4  # of the boundary's size: there differences of rates are linear
TERMS = ("remainder", "disturbance", "saturation", "hold", "curvature", "motion")
NAMES = {
    "remainder": "what the Taylor cubics leave out",
    "disturbance": "the disturbance w",
    "saturation": "the inputs' limits",
    "hold": "an input that is held, and computed from a measurement,",
    "curvature": "the curvature of the dynamics",
    "motion": "the motion's own error, f(t, x0, u0) - dx0/dt,",
}
ADVICE = {
    "remainder": "take more knots, a slower motion, or a smaller goal: it falls with the fourth "
    "power of the funnel's size",
    "disturbance": "take a larger goal, feedback that acts faster (a smaller R), or narrower "
    "bounds of w: a smaller goal makes it worse",
    "saturation": "take a motion that leaves the inputs more room, wider limits, or a smaller goal",
    "hold": "take a shorter hold, smaller measurement errors, or a larger goal",
    "curvature": "take a smaller goal, a slower motion, or other Q and R",
    "motion": "give a motion with more knots, or one that obeys the dynamics more exactly",
    "knots": "take more knots, or feedback that acts slower (a larger R)",
    "linear": "the linear closed loop itself lets V grow there: take other Q and R, a policy that "
    "stabilises it, more knots, or a goal that is wider in the states that no input reaches",
}


@dataclass(frozen=True)
class Diagnosis:
    """linear: what the linear closed loop and ρ̇ let V fall by, in 1/s. taken: by each term of

    `TERMS`, in 1/s, at t in s. widths: half-widths of the set that was tried there.
    """

    t: float
    linear: float
    taken: dict[str, float]
    widths: tuple[float, ...]

    @property
    def left(self) -> float:
        """What V falls by at this instant, in 1/s."""
        return self.linear - sum(self.taken.values())

    @property
    def dominant(self) -> str:
        """The term to act on; "knots" if V falls at this instant, and not all the way to it."""
        if self.left > 0:
            return "knots"
        largest = max(TERMS, key=lambda name: self.taken[name])
        return "linear" if self.taken[largest] <= -self.linear else largest

    @property
    def cause(self) -> str:
        """The term to act on, in words."""
        words = {"knots": "what lies between knots", "linear": "the linear closed loop itself"}
        return (NAMES | words)[self.dominant].rstrip(",")

    def __str__(self) -> str:
        total = sum(part for part in self.taken.values() if part > 0) or 1.0
        shares = sorted(((p, name) for name, p in self.taken.items() if p > 0), reverse=True)
        least = max(0.01 * total, NOISE * abs(self.linear))
        taking = "; ".join(
            f"{NAMES[n]} takes {p:.3g} 1/s ({100 * p / total:.0f} %)"
            for p, n in shares
            if p >= least
        )
        sizes = ", ".join(f"{width:.3g}" for width in self.widths)
        if self.dominant == "knots":
            return (
                f"no funnel at t = {self.t:.6g} s: around the motion within ({sizes}) V falls by "
                f"{self.left:.3g} 1/s at this instant, but it is not shown to fall in the whole "
                f"interval between the knots: {ADVICE['knots']}"
            )
        cause = "that" if self.dominant == "linear" else self.cause
        return (
            f"no funnel at t = {self.t:.6g} s: around the motion within ({sizes}) the linear "
            f"closed loop lets V fall by {self.linear:.3g} 1/s, and "
            f"{taking or 'nothing else is lost'}. Because of {cause}: {ADVICE[self.dominant]}"
        )


class NoFunnel(Infeasible):
    """No ρ at t, in s. left: what the margin was short of there, in 1/s, if it is known.

    diagnosis: why, worked out by `why` when somebody asks: a search refuses much on its way.
    """

    def __init__(self, t: float, why: Callable[[], Diagnosis], left: float = -np.inf) -> None:
        super().__init__(f"no funnel at t = {t:.6g} s")
        self.t, self.left, self._why = t, left, why

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """What lets V fall there, and what takes it away."""
        return self._why()

    def __str__(self) -> str:
        return str(self.diagnosis)


def diagnosed(
    steps: LSteps, sections: Sequence[Section], rhos: Sequence[float], growth: float
) -> Diagnosis:
    """The terms at the one of these instants, with these ρ and ρ̇ = growth, where least is left."""
    worst: tuple[float, Section, float, int, FloatArray] | None = None
    for section, rho in zip(sections, rhos, strict=True):
        try:
            found = steps.solve(section, rho)
        except SolverError:
            continue
        for case, solution in enumerate(found):
            left = solution.upper + growth / rho
            if worst is None or left < worst[0]:
                worst = (left, section, rho, case, solution.y)
    if worst is None:  # no program was solved: the mean over the boundary is all there is
        y = np.full(len(steps.program.points), 1 / len(steps.program.points))
        worst = (0.0, sections[0], rhos[0], 0, y)
    _, section, rho, case, y = worst
    linear, parts = _terms(steps, section, rho, case)
    taken = dict.fromkeys(TERMS, 0.0) | {name: -float(p @ y) for name, p in parts.items()}
    widths = np.sqrt(rho * np.diag(np.linalg.inv(section.shape.P)))
    return Diagnosis(
        section.t, float(linear @ y) + growth / rho, taken, tuple(float(w) for w in widths)
    )


def _terms(
    steps: LSteps, section: Section, rho: float, case: int
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """-Ẇ/ρ of the linear closed loop at the program's points, and of each term beside it."""
    x_bar = np.sqrt(rho) * steps.program.points @ section.shape.base.T
    centre = steps.field.uncertain.mean(axis=1)

    def falls(rates: FloatArray) -> FloatArray:
        return np.asarray(-2 * np.einsum("ij,ij->i", x_bar @ section.shape.P, rates) / rho)

    def rate(scale: float) -> FloatArray:
        moved = scale * x_bar
        return steps.rate(section, section.x + moved, section.u - moved @ section.K.T, centre)

    at_motion = rate(0.0)
    slope = (rate(CLOSE) - rate(-CLOSE)) / (2 * CLOSE)
    turning = np.einsum("ij,ij->i", x_bar @ section.shape.rate, x_bar) / rho
    whole = rate(1.0)
    parts = {
        "curvature": falls(whole - at_motion - slope),
        "motion": falls(at_motion - section.x_rate),
    }
    own = (
        len(steps.field.uncertain)
        if not (steps.field.expansion or steps.local)
        else (
            len(steps.local[section.interval].rates.uncertain)
            if section.interval in steps.local
            else 0
        )
    )
    if steps.kappa is not None:
        pushed = -steps.from_pushes(section, x_bar) / rho
    else:
        pushed = np.zeros((len(x_bar), len(centre)))
        corner = steps.off(section.interval)[case % len(steps.corners), steps.field.m :]
        for j, value in enumerate(corner.tolist()):
            w = centre.copy()
            w[j] = value
            U = section.u - x_bar @ section.K.T
            pushed[:, j] = falls(steps.rate(section, section.x + x_bar, U, w) - whole)
    parts["disturbance"] = pushed[:, :own].sum(axis=1)
    parts["remainder"] = pushed[:, own:].sum(axis=1)
    linear = falls(slope) - turning
    # The same corner where no input is at a limit: modes come in that order.
    free = case % len(steps.corners)
    here, unlimited = steps.values(section, rho, [case, free])
    parts["saturation"] = here - unlimited
    cause = "motion" if steps.widths is None else "hold"
    rest = unlimited - linear - sum(parts.values()) + parts["saturation"]
    parts[cause] = parts.get(cause, 0.0) + np.asarray(rest)
    return linear, parts
