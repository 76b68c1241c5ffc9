"""`MonitorBank`: one robot held against several funnels of its model at once.

The funnels' matrices are stacked, so ten cost little more than one; each funnel's numbers are the
same bit for bit whether it is held alone or in a bank.
"""

import math
from collections.abc import Sequence

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray
from nlsid_core.errors import CertificateMismatch, DataError
from nlsid_core.funnel import Funnel
from nlsid_core.models import DifferenceEquation
from nlsid_core.policy import Policy
from nlsid_core.reading import Nominal, Reading, Status

GRID_TOLERANCE = 0.25  # of a period: a stamp this far off the grid is still that sample
COMMAND_TOLERANCE = 1e-9  # relative: rounding between computing a policy's input and recording it

Pairs = Sequence[tuple[Policy, Funnel]]


class MonitorBank:
    """Holds samples (t, y, u) of one run against m funnels; `update` once per sample, in order.

    A run starts with the first sample. It ends, for all funnels, at the first sample that is
    missing, not finite or out of order, and for each funnel with its horizon; after that every
    reading is unknown until `restart`. u is the input applied from t on (the latest command with a
    stamp not after t).

    Raises CertificateMismatch if model, policies and funnels do not belong together, DataError if
    there are none.
    """

    def __init__(
        self, model: DifferenceEquation, pairs: Pairs, *, nominal: Nominal = Nominal.COMMAND
    ) -> None:
        if not pairs:
            raise DataError("no funnel to hold the state against")
        _check_that_they_belong_together(model, pairs, nominal)
        self.model, self.nominal = model, nominal
        self.funnels = tuple(funnel for _, funnel in pairs)
        policies = [policy for policy, _ in pairs]
        n, m = len(model), len(pairs)
        self.axes = (*(f"{model.y.name} +{i}" for i in range(n)), "innovation")
        # x̂⁺ = A x̂ + B u + f + L e, transposed, as one product with the row [x̂, u, 1, e]
        self._step = np.array(
            [np.vstack([model.A.T, model.B.T, model.offset, policy.L]) for policy in policies]
        )
        self._P = np.array([funnel.P for funnel in self.funnels])
        self._half_widths = np.array([funnel.axis_half_widths for funnel in self.funnels])
        self._level = np.array([funnel.level for funnel in self.funnels])
        self._budget = np.array([funnel.assumption.budget for funnel in self.funnels])
        self._samples = [funnel.assumption.samples for funnel in self.funnels]
        if nominal is Nominal.PROFILE:
            longest = max(self._samples) + 1
            self._K = np.array([policy.K for policy in policies])
            self._x_plan = np.array([_held(policy.x, longest) for policy in policies])
            self._u_plan = np.array([_held(policy.u, longest) for policy in policies])
        self._rows = np.zeros((m, 2, n + 3))  # [x̂, u, 1, e] and [x_k, u_k, 1, 0] of each funnel
        self._rows[:, :, n + 1] = 1.0
        self._deviation = np.empty((m, n + 1))  # [x̄, e]
        self._name_parts()
        self.restart()

    def _name_parts(self) -> None:
        """Views of the stacked rows, made once: slicing is a third of an update otherwise."""
        n, rows = len(self.model), self._rows
        self._x, self._x_nominal = rows[:, 0, :n], rows[:, 1, :n]
        self._x_both = rows[:, :, :n]
        self._y_past, self._y_nominal = rows[:, 0, 0], rows[:, 1, 0]
        self._u, self._u_nominal = rows[:, 0, n], rows[:, 1, n]
        self._e = rows[:, 0, n + 2]
        self._x_bar, self._e_bar = self._deviation[:, :n], self._deviation[:, n]
        self._x_bar_row, self._x_bar_column = self._x_bar[:, None, :], self._x_bar[:, :, None]
        self._D, self._c = self.model.D, self.model.c

    def __len__(self) -> int:
        """The number of funnels m."""
        return len(self.funnels)

    def restart(self) -> None:
        """Begin a new run: forget lags, budget and why the last run ended."""
        self._y_lags: list[float] = []
        self._u_lags: list[float] = []
        self._last_t = -math.inf
        self._k = -1  # until the first n samples are there
        self._spent = np.zeros(len(self))
        self._ended = ""
        self._violated = [""] * len(self)

    def missing(self, t: float, reason: str) -> list[Reading]:
        """End the run because the state is missing or stale at time t (s): unknown from here on."""
        self._ended = self._ended or reason
        return [Reading(t, Status.UNKNOWN, reason=self._ended)] * len(self)

    def update(self, t: float, y: float, u: float) -> list[Reading]:
        """One reading per funnel at stamp t (s) for output y and the input u applied from t on."""
        if not self._ended:
            self._ended = self._fault(t, y, u)
        if self._ended:
            return [Reading(t, Status.UNKNOWN, measured=y, reason=self._ended)] * len(self)
        self._last_t = t
        if self._k >= max(self._samples):
            return [
                Reading(t, Status.UNKNOWN, measured=y, reason=self._over(samples))
                for samples in self._samples
            ]
        if self._k < 0:
            return self._collect(t, y, u)
        return self._judge(t, y, u)

    def _fault(self, t: float, y: float, u: float) -> str:
        """Why this sample cannot be judged, empty if it can."""
        step, period = t - self._last_t, self.model.period
        if abs(step - period) <= GRID_TOLERANCE * period and math.isfinite(y) and math.isfinite(u):
            return ""
        name = self.model.y.name
        if not math.isfinite(t):
            return f"stamp is {t}"
        if not math.isfinite(y):
            return f"{name} is {y} at t = {t:g} s"
        if not math.isfinite(u):
            return f"no {self.model.u.name} at t = {t:g} s (it is {u})"
        if step <= 0:
            return f"time went back by {-step:g} s at t = {t:g} s"
        if math.isfinite(step):
            return f"{step:g} s between samples at t = {t:g} s; the model's period is {period:g} s"
        return ""

    def _over(self, samples: int) -> str:
        return f"the proof covers {samples * self.model.period:g} s; they are over"

    def _collect(self, t: float, y: float, u: float) -> list[Reading]:
        """Gather the first n samples, which give the observers their exact state."""
        n = len(self.model)
        self._y_lags.append(y)
        self._u_lags.append(u)
        if len(self._y_lags) == n:
            x = self.model.state_after(self._y_lags, self._u_lags)
            planned = self._x_plan[:, 0] if self.nominal is Nominal.PROFILE else x
            self._x[:], self._x_nominal[:] = x, planned
            self._k = 0
            deviations = np.broadcast_to(x - planned, (len(self), n))
            for i, (funnel, x_bar) in enumerate(zip(self.funnels, deviations, strict=True)):
                start = funnel.value(x_bar, 0.0)
                if start > funnel.inlet:
                    self._violated[i] = (
                        f"started outside the inlet: V = {start:.3g} > {funnel.inlet:.3g}"
                    )
        reason = f"waiting for the first {n} samples"
        return [Reading(t, Status.UNKNOWN, measured=y, reason=reason)] * len(self)

    def _judge(self, t: float, y: float, u: float) -> list[Reading]:
        k, played, D, c = self._k, self.nominal is Nominal.COMMAND, self._D, self._c
        self._u[:] = u
        self._u_nominal[:] = u if played else self._u_plan[:, k]
        innovation = y - (self._y_past + (D * u + c))
        self._e[:] = innovation
        self._e_bar[:] = innovation
        np.subtract(self._x, self._x_nominal, out=self._x_bar)
        energy = innovation * innovation
        self._spent += energy
        value = (self._x_bar_row @ self._P @ self._x_bar_column)[:, 0, 0] + energy
        worst = (np.abs(self._deviation) / self._half_widths).argmax(axis=1).tolist()
        output = self._y_nominal + (D * self._u_nominal + c)
        spent = (self._spent / self._budget).tolist()
        u_policy = None
        if not played:
            u_policy = (self._u_plan[:, k] - (self._K * self._x_bar).sum(axis=1)).tolist()
        if u_policy is not None or max(spent) >= 1.0 or not self._in_range(u):
            self._note_violations(t, u, u_policy)
        margins = (1.0 - np.sqrt(value / self._level)).tolist()
        columns = zip(value.tolist(), margins, spent, output.tolist(), strict=True)
        self._x_both[:] = self._rows @ self._step
        self._k += 1
        if not played:
            self._x_nominal[:] = self._x_plan[:, self._k]
        readings = []
        for i, (V, margin, share, planned) in enumerate(columns):
            if k >= self._samples[i]:
                over = self._over(self._samples[i])
                readings.append(Reading(t, Status.UNKNOWN, measured=y, reason=over))
                continue
            status, reason = self._verdict(i, V)
            readings.append(
                Reading(t, status, margin, self.axes[worst[i]], share, planned, y, reason)
            )
        return readings

    def _in_range(self, u: float) -> bool:
        lo, hi = self.model.u_range
        return lo <= u <= hi

    def _note_violations(self, t: float, u: float, u_policy: list[float] | None) -> None:
        """Remember the first way in which what each proof assumes stopped being so."""
        name, (lo, hi) = self.model.u.name, self.model.u_range
        for i, (spent, budget) in enumerate(zip(self._spent, self._budget, strict=True)):
            if self._violated[i]:
                continue
            if spent > budget:
                self._violated[i] = (
                    f"disturbance energy {spent:.4g} above the budget {budget:.4g} at t = {t:g} s"
                )
            elif not lo <= u <= hi:
                self._violated[i] = f"{name} {u:g} outside the fitted range [{lo:g}, {hi:g}]"
            elif u_policy is not None:
                meant = u_policy[i]
                if abs(u - meant) > COMMAND_TOLERANCE * (1.0 + abs(meant)):
                    self._violated[i] = (
                        f"{name} {u:.6g} is not the policy's {meant:.6g} at t = {t:g} s"
                    )

    def _verdict(self, i: int, value: float) -> tuple[Status, str]:
        violated = self._violated[i]
        if value <= self.funnels[i].level:
            return (Status.ASSUMPTION_VIOLATED, violated) if violated else (Status.INSIDE, "")
        if violated:
            return Status.OUTSIDE, f"outside the tube; {violated}"
        why = "outside although the assumption was kept: what runs is not what was proved"
        return Status.OUTSIDE, why


def _check_that_they_belong_together(
    model: DifferenceEquation, pairs: Pairs, nominal: Nominal
) -> None:
    digest = _json.digest(model.document())
    for policy, funnel in pairs:
        if policy.model != digest or funnel.model != digest:
            raise CertificateMismatch("policy or funnel was made for another model")
        if funnel.policy != _json.digest(policy.document()):
            raise CertificateMismatch("the funnel was made for another policy")
        if policy.period != model.period:
            raise CertificateMismatch("the policy has another sample time than the model")
        if nominal is Nominal.PROFILE and len(policy) < funnel.assumption.samples:
            raise CertificateMismatch(
                f"the policy plans {len(policy)} samples, the funnel {funnel.assumption.samples}"
            )


def _held(plan: FloatArray, length: int) -> FloatArray:
    """`plan` cut to `length` samples, or with its last one repeated."""
    return plan[np.minimum(np.arange(length), len(plan) - 1)]
