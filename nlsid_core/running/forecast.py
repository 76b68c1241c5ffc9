"""`Forecast`: between which values the outputs are at the next samples, from the present estimate.

Start a second simulation at the observer's state x̂ now: x̄ = 0, so that only the innovations of
the next h samples part the robot from it. With what their assumption leaves,
    B = level - ρ^h E,        |y_j - forecast_j|² <= B reach_j(h).
A tube's proof decides (D) and (O_j), from which the reach follows; no proof states the reach.
Source: docs/theory.md, "Forecasts".
"""

from typing import NamedTuple

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.funnels.factor import STEPS, UNIT
from nlsid_core.funnels.tube import Tube
from nlsid_core.kernel import Rejected
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.models import read_model
from nlsid_core.models import DifferenceEquation, ImplicitModel, StableModel, StateAffineModel

OUTWARD = 1e-8  # relative: more than float64 can hide of a reach, a level or an output
MOST_STEPS = 20_000  # after which a response that has not faded is not looked at any more
FADED = 1e-9  # of a response of 1: what follows is less than a part in a million of its sum


class Forecast(NamedTuple):
    """The outputs while what the tubes assume is kept, sample by sample after the newest one.

    t: (h,) s after it; low, high: (h, p) in the outputs' units. reason: why it ends before the last
    of the inputs; empty if it does not.
    """

    t: FloatArray
    low: FloatArray
    high: FloatArray
    reason: str


class Linear(NamedTuple):
    """x̄⁺ = A x̄ + L e, o = C x̄ + e, and how much of A's entries rounding can hide, relative."""

    A: FloatArray
    C: FloatArray
    rounding: float

    @property
    def carried(self) -> FloatArray:
        """(p, n) the sum of |C Aᵏ|: what a change of every state by 1 at every step can become.

        inf where that is not known after so many steps.
        """
        power, total = np.eye(len(self.A)), np.zeros_like(self.C)
        for _ in range(MOST_STEPS):
            total += np.abs(self.C @ power)
            power = self.A @ power
            if np.max(np.abs(power)) < FADED:
                return total
        return np.full_like(self.C, np.inf)

    def rounded(self, largest: FloatArray) -> FloatArray:
        """(n,) the most that one step is off by, where |x| <= largest (n,)."""
        each = 4.0 * (len(self.A) + STEPS) * (UNIT + self.rounding)
        return np.asarray(each * (np.abs(self.A) @ largest + largest))


def linear_form(model: StableModel) -> Linear | None:
    """The form of a model whose increments are the same everywhere; else None."""
    varies = isinstance(model, StateAffineModel) and any(g.exponents.any() for g in model.G)
    if varies or not isinstance(model, DifferenceEquation | ImplicitModel | StateAffineModel):
        return None
    try:
        form = read_model(parse(files.encode(model.document()), "model"))
    except Rejected:  # an implicit one that needs a box
        return None
    if form.E.ray:
        return None
    F, H = (np.array(part, dtype=np.float64) for part in (form.F, form.H))
    m = form.unknowns
    if not m:
        return Linear(F, H, UNIT)
    E = np.array(form.E.vertices(form.E.box)[0], dtype=np.float64)
    back = np.linalg.solve(E[:, :m], E[:, m:])
    A, C = F[:, m:] - F[:, :m] @ back, H[:, m:] - H[:, :m] @ back
    return Linear(A, C, (m + STEPS) * UNIT * float(np.linalg.cond(E[:, :m])))


def reach(tube: Tube, linear: Linear | None, steps: int) -> FloatArray:
    """(steps, p): the most of |y_j - forecast_j|² after 1, 2 … samples, where B = 1; rounded up.

    After m steps |x̄|² in P is at most min(1, λ m) of what E spent, λ the largest eigenvalue of
    R⁻¹L'PL, at most 1; a linear model's own response is never worse.
    """
    inverse = np.linalg.inv(tube.R)
    single = np.diag(inverse)
    direct = 0.0 if tube.peak is None else 1.0 - (1.0 - tube.peak.direct) ** 2
    ever = 1.0 / tube.tau + direct * single  # τ bounds the output but for what is direct
    if linear is None:
        spread = np.linalg.eigvals(inverse @ tube.L.T @ tube.P @ tube.L).real.max()
        parts = np.minimum(1.0, spread * np.arange(steps))
        return np.asarray(np.minimum(ever, single + parts[:, None] * ever) * (1.0 + OUTWARD))
    A, C, n = linear.A, linear.C, len(tube.P)
    root = np.linalg.cholesky(inverse)
    hidden = 2.0 * (n + STEPS) * UNIT + linear.rounding
    weights = np.abs(tube.factor) @ np.abs(A)
    # |o_j|² <= B (R⁻¹_jj + Σ_q ρ^-(q+1) |C_j A^q L|²), the norm that of R⁻¹; `off` is what rounding
    # can have added to A^q L, in P, where A shrinks it by √ρ a step.
    found, total, response, off = [], single.copy(), tube.L @ root, 0.0
    for q in range(steps):
        found.append(total.copy())
        rows = np.linalg.norm(C @ response, axis=1) * (1.0 + hidden)
        rows = rows + np.sqrt(tube.rho / tube.tau) * off
        total = total + rows**2 / tube.rho ** (q + 1)
        added = float(np.linalg.norm(weights @ np.abs(response)))
        off = np.sqrt(tube.rho) * off + hidden * added
        response = A @ response
    return np.asarray(np.minimum(np.array(found), ever) * (1.0 + OUTWARD))
