"""`TrackingMonitor`: a running robot against its funnel, its disturbance against the bound.

One sample in, one `TrackingReading` out; the controller, the measurement of commissioning runs, the
replay and the live monitor share the observer below, so that they agree bit for bit. A positive
margin is good. Missing, stale or NaN state reads as unknown, never as inside.
"""

import math
from collections import deque

import numpy as np

from nlsid_core import _json
from nlsid_core._types import ArrayLike, FloatArray
from nlsid_core.discrete_funnel import DiscreteFunnel
from nlsid_core.errors import CertificateMismatch, DataError, ShapeError, SolverError
from nlsid_core.models.measured_state import MeasuredState
from nlsid_core.monitor import COMMAND_TOLERANCE, GRID_TOLERANCE
from nlsid_core.reading import Level, Status, TrackingReading
from nlsid_core.tracking_policy import TrackingPolicy
from nlsid_core.trajectory import Trajectory

OVER = "the proof covers"  # how the reason of every reading after the horizon begins
TREND = 5  # samples over which the margin's trend is taken


class StateObserver:
    """x̂⁺ = f(x̂, u) + d, d = L(y⁺ - f(x̂, u)), from x̂_0 = y_0."""

    def __init__(self, model: MeasuredState, L: FloatArray) -> None:
        self._model, self._L = model, L
        self.x: FloatArray | None = None
        self.predicted: FloatArray | None = None  # f(x̂, u), before the correction
        self.d: FloatArray = np.zeros(len(model))

    def update(self, y: FloatArray, u_before: FloatArray | None) -> FloatArray:
        """The estimate (n,) at this sample, from y (n,) and the input (p,) since the last one.

        Raises SolverError if an implicit model's step finds no root.
        """
        if self.x is None or u_before is None:
            self.x = np.array(y)
            return self.x
        self.predicted = self._model(self.x, u_before)
        self.d = self._L @ (y - self.predicted)
        self.x = self.predicted + self.d
        return self.x


class DisturbanceMeter:
    """What an assumption bounds, sample by sample; see `DisturbanceAssumption`."""

    def __init__(
        self, S: FloatArray, A: FloatArray, form: str, rate: float = 1.0, gain: float = 1.0
    ) -> None:
        self._S, self._A, self._form, self._rate, self._gain = S, A, form, rate, gain
        self._r: FloatArray = np.zeros(S.shape[1])
        self._energy = 0.0

    def update(self, k: int, d: FloatArray) -> float:
        """The quantity at sample k > 0, d (n,) being the observer's correction there."""
        size = float(np.linalg.norm(self._S[k] @ d))
        if self._form == "peak":
            return size
        if self._form == "response":
            self._r = self._A[k - 1] @ self._r + d
            return float(np.linalg.norm(self._S[k] @ self._r))
        self._energy = self._rate * self._energy + self._gain * size**2
        return math.sqrt(self._energy)


def disturbance_of(
    model: MeasuredState,
    policy: TrackingPolicy,
    run: Trajectory,
    *,
    S: FloatArray,
    A: FloatArray,
    form: str = "response",
    rate: float = 1.0,
    gain: float = 1.0,
) -> FloatArray:
    """(N + 1,) what an assumption of this form bounds, along a run of the policy.

    The run starts with sample 0 of the nominal; y is the measured state, u what was applied.
    Raises DataError if it is shorter than the policy.
    """
    if len(run) < len(policy):
        raise DataError(f"{run.name}: {len(run)} samples, the policy has {len(policy)} steps")
    observer, meter = StateObserver(model, policy.L), DisturbanceMeter(S, A, form, rate, gain)
    sizes = np.zeros(len(policy) + 1)
    last = min(len(run) - 1, len(policy))
    for k in range(last + 1):
        observer.update(run.y[k], run.u[k - 1] if k else None)
        if k:
            sizes[k] = meter.update(k, observer.d)
    return sizes


class TrackingMonitor:
    """Holds samples (t, y, u) of one run against a funnel; `update` once per sample, in order.

    A run starts with the first sample, which has to be the nominal's sample 0, and ends with the
    nominal's last or at the first sample that is missing, not finite or off the grid; after that
    every reading is unknown until `restart`. u is the input applied from this sample on.

    Raises CertificateMismatch if model, policy and funnel do not belong together.
    """

    lags = 0  # samples before the run's start that it needs

    def __init__(
        self, model: MeasuredState, policy: TrackingPolicy, funnel: DiscreteFunnel
    ) -> None:
        digest = _json.digest(model.document())
        if policy.model != digest or funnel.model != digest:
            raise CertificateMismatch("policy or funnel was made for another model")
        if funnel.policy != _json.digest(policy.document()):
            raise CertificateMismatch("the funnel was made for another policy")
        self.model, self.policy, self.funnel = model, policy, funnel
        self._radius, self._half_widths = funnel.radius, funnel.half_widths
        self.restart()

    def restart(self) -> None:
        """Begin a new run."""
        self._observer = StateObserver(self.model, self.policy.L)
        a = self.funnel.assumption
        self._meter = DisturbanceMeter(self.funnel.S, self.funnel.A, a.form, a.rate, a.gain)
        self._u_before: FloatArray | None = None
        self._k = 0
        self._last_t = -math.inf
        self._ended = self._violated = ""
        self._margins: deque[float] = deque(maxlen=TREND + 1)

    def waiting(self, t: float, _y: ArrayLike, reason: str) -> TrackingReading:
        """The reading at t (s) of a sample y before the run's start."""
        return TrackingReading(t, Status.UNKNOWN, reason=reason)

    def missing(self, t: float, reason: str) -> TrackingReading:
        """End the run because the state is missing or stale at time t (s): unknown from here on."""
        self._ended = self._ended or reason
        return TrackingReading(t, Status.UNKNOWN, reason=self._ended)

    def update(self, t: float, y: ArrayLike, u: ArrayLike | None) -> TrackingReading:
        """The reading at stamp t (s): measured state y (n,), input u (p,) applied from t on.

        u may be None at the nominal's last sample.
        """
        state = np.asarray(y, dtype=np.float64)
        applied = None if u is None else np.atleast_1d(np.asarray(u, dtype=np.float64))
        if state.shape != (len(self.model),):
            raise ShapeError(f"the state should have shape ({len(self.model)},): {state.shape}")
        self._ended = self._ended or self._fault(t, state, applied)
        if self._ended:
            return TrackingReading(t, Status.UNKNOWN, reason=self._ended)
        return self._judge(t, state, applied)

    def _fault(self, t: float, y: FloatArray, u: FloatArray | None) -> str:
        """Why this sample cannot be judged, empty if it can."""
        period, step = self.model.period, t - self._last_t
        if not math.isfinite(t) or not np.isfinite(y).all():
            return f"state {y} at t = {t:g} s"
        if self._k > len(self.policy):
            return f"{OVER} {len(self.policy) * period:g} s; they are over"
        if self._k < len(self.policy) and (u is None or not np.isfinite(u).all()):
            return f"no input at t = {t:g} s (it is {u})"
        if step <= 0:
            return f"time went back by {-step:g} s at t = {t:g} s"
        if math.isfinite(step) and abs(step - period) > GRID_TOLERANCE * period:
            return f"{step:g} s between samples at t = {t:g} s; the model's period is {period:g} s"
        return ""

    def _judge(self, t: float, y: FloatArray, u: FloatArray | None) -> TrackingReading:
        k, funnel = self._k, self.funnel
        try:
            x = self._observer.update(y, self._u_before)
        except SolverError as error:
            self._ended = f"the model has no next state at t = {t:g} s: {error}"
            return TrackingReading(t, Status.UNKNOWN, reason=self._ended)
        x_bar, S = x - self.policy.x[k], funnel.S[k]
        size = float(np.linalg.norm(S @ x_bar))
        disturbance = self._meter.update(k, self._observer.d) if k else 0.0
        self._note_violations(t, k, size, disturbance, x, u)
        radius = float(self._radius[k])
        margin = 1.0 - size / radius
        self._margins.append(margin)
        status = Status.ASSUMPTION_VIOLATED if self._violated else Status.INSIDE
        reason = self._violated
        if size > radius:
            status = Status.OUTSIDE
            kept = "outside although the assumption was kept: what runs is not what was proved"
            reason = f"outside the tube; {self._violated}" if self._violated else kept
        self._last_t, self._u_before, self._k = t, u, k + 1
        bound = funnel.assumption.bound
        return TrackingReading(
            t=t,
            status=status,
            margin=margin,
            disturbance=disturbance / bound if bound else math.inf * bool(disturbance),
            level=self._level(k, size, radius),
            time_to_exit=self._time_to_exit(margin),
            worst_axis=self.model.x[int(np.argmax(np.abs(x_bar) / self._half_widths[k]))].name,
            reason=reason,
            deviation=tuple(x_bar.tolist()),
        )

    def _note_violations(
        self,
        t: float,
        k: int,
        size: float,
        disturbance: float,
        x: FloatArray,
        u: FloatArray | None,
    ) -> None:
        """Remember the first way in which what the proof assumes stopped being so."""
        if self._violated:
            return
        funnel = self.funnel
        if k == 0 and size > funnel.tube[0]:
            self._violated = f"started outside: {size:.4g} > {funnel.tube[0]:.4g}"
        elif self._farther_than_roots(k):
            self._violated = (
                f"the model's step ended at a root beyond the proved ones at t = {t:g} s"
            )
        elif disturbance > funnel.assumption.bound:
            self._violated = (
                f"disturbance {funnel.assumption.form} {disturbance:.4g} above the assumed "
                f"{funnel.assumption.bound:.4g} at t = {t:g} s"
            )
        elif u is not None and k < len(self.policy):
            wanted = self.policy(k, x)
            worst = int(np.argmax(np.abs(u - wanted)))
            if abs(u[worst] - wanted[worst]) > COMMAND_TOLERANCE * (1.0 + abs(wanted[worst])):
                self._violated = (
                    f"{self.model.u[worst].name} {u[worst]:.6g} is not the policy's "
                    f"{wanted[worst]:.6g} at t = {t:g} s"
                )

    def _farther_than_roots(self, k: int) -> bool:
        """Whether an implicit step's next rates are farther from the nominal than was proved."""
        predicted, roots = self._observer.predicted, self.funnel.roots
        if roots is None or predicted is None:
            return False
        d = len(predicted) // 2
        away = (predicted - self.policy.x[k])[d:]
        return float(np.linalg.norm(self.funnel.S[k][d:, d:] @ away)) > float(roots[k])

    def _level(self, k: int, size: float, radius: float) -> Level:
        inlet = float(self.funnel.inlet[k])
        if k == len(self.policy) and size <= inlet + self.funnel.margin:
            return Level.GOAL
        if size <= radius:
            return Level.TUBE
        return Level.INLET if size <= inlet else Level.NONE

    def _time_to_exit(self, margin: float) -> float:
        if margin <= 0 or len(self._margins) < 2:
            return 0.0 if margin <= 0 else math.inf
        fall = (self._margins[0] - margin) / (len(self._margins) - 1)
        return margin / fall * self.model.period if fall > 0 else math.inf
