"""`ContinuousTracking`: what a funnel of given equations is asked for, and the goal it ends in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.dynamics import Nominal, VectorField
from nlsid_core.errors import OptionError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.options import require_one_of
from nlsid_core.policies.continuous import ContinuousPolicy

Shape = Literal["rho", "P"]
START_ROOM = 1 + 1e-6  # of the next funnel's matrix: the checker decides in rationals


@dataclass(frozen=True, eq=False)
class Goal:
    """The set to end in, {x : |x - centre|²_P ≤ 1}; centre: (n,), P: (n, n) ≻ 0."""

    centre: FloatArray
    P: FloatArray

    @classmethod
    def start_of(cls, funnel: ContinuousFunnel) -> Goal:
        """A little less than where `funnel` starts, so that the two compose."""
        P = START_ROOM * funnel.P[0] / funnel.rho[0]
        return cls(funnel.x.ends()[0], np.asarray((P + P.T) / 2))


@dataclass(frozen=True, eq=False)
class ContinuousTracking:
    """The largest funnel around a nominal motion that ends in a goal, proved for every t.

    dynamics: a VectorField, or a function of some of t, x, u, w, named so; one that is no
    polynomial is expanded on every interval around what the funnel needs there, see
    `dynamics.taylor`. uncertain: rows (low, high) of the w of such a function. goal: half-widths
    (n,) of an ellipsoid around the nominal's end, its matrix, or a `Goal`. policy: None is a
    time-varying LQR with Q (n, n) and R (m, m) (None: on the goal's scale, see `default_weights`),
    and P(t) its cost-to-go; for a given policy P(t) solves the Lyapunov equation with Q. limits:
    rows (input, low, high), or one pair (low, high) for each input, at which inputs saturate; the
    proof then covers every mode.

    hold: s, how old the input that is applied may be: the time between samples, and any delay
    ("largest": the longest that is found to be provable, to a factor √2; None: the policy is
    assumed to act continuously). K is then linear between knots. error: (n,)
    bounds of how much each state is measured wrong (None: not at all).

    shape "rho": P(t) stays and ρ(t) is swept backward. shape "P": P(t) itself is searched from
    there. Source: thesis Chapters 5, 6.
    """

    dynamics: VectorField | Callable[..., Any]
    nominal: Nominal
    goal: Goal | ArrayLike
    policy: ContinuousPolicy | None = None
    shape: Shape = "rho"
    Q: ArrayLike | None = None
    R: ArrayLike | None = None
    limits: ArrayLike | None = None
    uncertain: ArrayLike | None = None
    hold: float | Literal["largest"] | None = None
    error: ArrayLike | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.nominal, Nominal):
            raise OptionError("nominal", self.nominal, "a Nominal, such as plan_motion returns")
        if not isinstance(self.policy, ContinuousPolicy | None):
            raise OptionError("policy", self.policy, "a ContinuousPolicy, or None for an LQR")
        require_one_of(self, "shape", get_args(Shape))
