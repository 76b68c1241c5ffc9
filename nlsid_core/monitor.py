"""`Monitor`: where is the running robot relative to its funnel, and is the assumption still kept?

One sample in, one `Reading` out; offline replay and the live node call the same code on the same
numbers, so their margins are equal bit for bit. A positive margin is good. Missing, stale or NaN
state reads as unknown, never as inside.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray
from nlsid_core.errors import CertificateMismatch
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.policy import Policy

GRID_TOLERANCE = 0.25  # of a period: a stamp this far off the grid is still that sample
COMMAND_TOLERANCE = 1e-9  # relative: rounding between computing a policy's input and recording it


class Status(Enum):
    """What a reading says, best to worst."""

    UNKNOWN = "unknown"
    INSIDE = "inside"
    ASSUMPTION_VIOLATED = "assumption violated"
    OUTSIDE = "outside"


class Nominal(Enum):
    """What the tube is around: the model driven by the received commands, or the policy's plan."""

    COMMAND = "command"
    PROFILE = "profile"


@dataclass(frozen=True)
class Reading:
    """One sample's verdict.

    t: s, the sample's stamp. margin: 1 - √((V + e²)/level), 1 on the nominal, 0 on the boundary of
    the tube, NaN if unknown. worst_axis: the axis nearest its bound: `speed +2`, what the past says
    of the speed two samples ahead, or `innovation`. budget_spent: Σe² so far over the budget, 1 is
    all of it. nominal, measured: the output, in its unit. reason: why it is not inside, empty if it
    is.
    """

    t: float
    status: Status
    margin: float = math.nan
    worst_axis: str = ""
    budget_spent: float = math.nan
    nominal: float = math.nan
    measured: float = math.nan
    reason: str = ""


class Monitor:
    """Holds samples (t, y, u) of one run against a funnel; `update` once per sample, in order.

    A run starts with the first sample and ends with the funnel's horizon, or at the first sample
    that is missing, not finite or out of order; after that every reading is unknown until
    `restart`. u is the input applied from t on (the latest command with a stamp not after t).

    Raises CertificateMismatch if model, policy and funnel do not belong together.
    """

    def __init__(
        self,
        model: DifferenceEquation,
        policy: Policy,
        funnel: Funnel,
        *,
        nominal: Nominal = Nominal.COMMAND,
    ) -> None:
        digest = _json.digest(model.document())
        if policy.model != digest or funnel.model != digest:
            raise CertificateMismatch("policy or funnel was made for another model")
        if funnel.policy != _json.digest(policy.document()):
            raise CertificateMismatch("the funnel was made for another policy")
        if policy.period != model.period:
            raise CertificateMismatch("the policy has another sample time than the model")
        self.model, self.policy, self.funnel, self.nominal = model, policy, funnel, nominal
        n = len(model)
        ahead = (f"{model.y.name} +{i}" for i in range(n))
        self.axes = (*ahead, "innovation")
        self._half_widths = funnel.axis_half_widths
        self._A, self._B, self._offset = model.A, model.B[:, 0], model.offset
        self.restart()

    def restart(self) -> None:
        """Begin a new run: forget lags, budget and why the last run ended."""
        self._y_lags: list[float] = []
        self._u_lags: list[float] = []
        self._last_t = -math.inf
        self._k = 0
        self._spent = 0.0
        self._ended = ""
        self._violated = ""
        self._x: FloatArray | None = None
        self._x_nominal: FloatArray = np.zeros(len(self.model))

    def missing(self, t: float, reason: str) -> Reading:
        """End the run because the state is missing or stale at time t (s): unknown from here on."""
        self._ended = self._ended or reason
        return Reading(t, Status.UNKNOWN, reason=self._ended)

    def update(self, t: float, y: float, u: float) -> Reading:
        """The reading at stamp t (s) for output y and the input u applied from t on."""
        period = self.model.period
        if not self._ended:
            self._ended = self._fault(t, y, u)
        if self._ended:
            return Reading(t, Status.UNKNOWN, measured=y, reason=self._ended)
        self._last_t = t
        if self._x is None:
            return self._collect(t, y, u)
        if self._k >= self.funnel.assumption.samples:
            self._ended = (
                f"the proof covers {self.funnel.assumption.samples * period:g} s; they are over"
            )
            return Reading(t, Status.UNKNOWN, measured=y, reason=self._ended)
        return self._judge(t, y, u)

    def _fault(self, t: float, y: float, u: float) -> str:
        """Why this sample cannot be judged, empty if it can."""
        name = self.model.y.name
        if not math.isfinite(t):
            return f"stamp is {t}"
        if not math.isfinite(y):
            return f"{name} is {y} at t = {t:g} s"
        if not math.isfinite(u):
            return f"no {self.model.u.name} at t = {t:g} s (it is {u})"
        step = t - self._last_t
        period = self.model.period
        if step <= 0:
            return f"time went back by {-step:g} s at t = {t:g} s"
        if math.isfinite(step) and abs(step - period) > GRID_TOLERANCE * period:
            return f"{step:g} s between samples at t = {t:g} s; the model's period is {period:g} s"
        return ""

    def _collect(self, t: float, y: float, u: float) -> Reading:
        """Gather the first n samples, which give the observer its exact state."""
        n = len(self.model)
        self._y_lags.append(y)
        self._u_lags.append(u)
        if len(self._y_lags) == n:
            self._x = self.model.state_after(self._y_lags, self._u_lags)
            planned = self.policy.x[0] if self.nominal is Nominal.PROFILE else self._x
            self._x_nominal = planned.copy()
            start = self.funnel.value(self._x - planned, 0.0)
            if start > self.funnel.inlet:
                self._violated = (
                    f"started outside the inlet: V = {start:.3g} > {self.funnel.inlet:.3g}"
                )
        reason = f"waiting for the first {n} samples"
        return Reading(t, Status.UNKNOWN, measured=y, reason=reason)

    def _judge(self, t: float, y: float, u: float) -> Reading:
        model, funnel = self.model, self.funnel
        x, x_nominal = self._x, self._x_nominal
        assert x is not None
        played = self.nominal is Nominal.COMMAND
        u_nominal = u if played else float(self.policy.u[self._k])
        innovation = y - (x[0] + model.D * u + model.c)
        x_bar = x - x_nominal
        value = funnel.value(x_bar, innovation)
        self._spent += innovation**2
        self._note_violations(t, u, None if played else self.policy(self._k, x))
        reading = Reading(
            t=t,
            status=self._status(value),
            margin=1.0 - math.sqrt(value / funnel.level),
            worst_axis=self._worst_axis(x_bar, innovation),
            budget_spent=self._spent / funnel.assumption.budget,
            nominal=float(x_nominal[0] + model.D * u_nominal + model.c),
            measured=y,
            reason=self._reason(value),
        )
        self._x = self._A @ x + self._B * u + self._offset + self.policy.L * innovation
        if played or self._k + 1 == len(self.policy):
            self._x_nominal = self._A @ x_nominal + self._B * u_nominal + self._offset
        else:
            self._x_nominal = self.policy.x[self._k + 1]
        self._k += 1
        return reading

    def _note_violations(self, t: float, u: float, u_policy: float | None) -> None:
        """Remember the first way in which what the proof assumes stopped being so."""
        if self._violated:
            return
        lo, hi = self.model.u_range
        budget = self.funnel.assumption.budget
        if self._spent > budget:
            self._violated = (
                f"disturbance energy {self._spent:.4g} above the budget {budget:.4g} at t = {t:g} s"
            )
        elif not lo <= u <= hi:
            self._violated = f"{self.model.u.name} {u:g} outside the fitted range [{lo:g}, {hi:g}]"
        elif u_policy is not None and abs(u - u_policy) > COMMAND_TOLERANCE * (1.0 + abs(u_policy)):
            self._violated = (
                f"{self.model.u.name} {u:.6g} is not the policy's {u_policy:.6g} at t = {t:g} s"
            )

    def _status(self, value: float) -> Status:
        if value > self.funnel.level:
            return Status.OUTSIDE
        return Status.ASSUMPTION_VIOLATED if self._violated else Status.INSIDE

    def _reason(self, value: float) -> str:
        if value > self.funnel.level and not self._violated:
            return "outside although the assumption was kept: what runs is not what was proved"
        if value > self.funnel.level:
            return f"outside the tube; {self._violated}"
        return self._violated

    def _worst_axis(self, x_bar: FloatArray, innovation: float) -> str:
        share = np.abs(np.append(x_bar, innovation)) / self._half_widths
        return self.axes[int(np.argmax(share))]
