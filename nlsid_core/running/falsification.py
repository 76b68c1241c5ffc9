"""Search for a falsification: samples of one run that break a tube's assumption from any start.

Over a window of samples the innovations of a tube's observer are affine in the state x̂ that it has
at the first of them, of models that are affine in their states. With every bound of the assumption
scaled to 1, max_ω min_x̂ Σ_j ω_j z_j(x̂) over weights of sum 1 is above 1 exactly where no x̂ keeps
all z_j <= 1. The weights are found by multiplying each with its z_j (Lawson). Nothing here is
trusted: the kernel decides what is found. Source: docs/certificate_falsification.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import DataError, SolverError
from nlsid_core.funnels.tube import Tube, TubeFunnel
from nlsid_core.models import DifferenceEquation, StableModel, StateAffineModel
from nlsid_core.running.stepping import Stepper

ROUNDS = 40  # of weights, a window
ENDS = 40  # samples at which windows may end, of those where the assumption is broken
ROOM = 1e-6  # relative: what is above its bound by less is not offered to the kernel
AFFINE = DifferenceEquation | StateAffineModel  # models that are affine in their states


@dataclass(frozen=True, eq=False)
class Falsification:
    """What a claim of this kind says and is proved by, but for the files that it is about.

    tube: its number, from 1. u (m, n_u): inputs from sample `run` on; y (N, p): outputs from sample
    `first` on, to the same last one. energy, peak: (N,), the weights.
    """

    tube: int
    run: int
    first: int
    u: FloatArray
    y: FloatArray
    energy: FloatArray
    peak: FloatArray

    def claim(self, about: Json, recording: Json) -> Json:
        """The claim, of the proof that `about` binds and of a recording {name, digest}."""
        return {
            "kind": "falsification",
            "about": about,
            "recording": recording,
            "tube": self.tube,
            "run": self.run,
            "first": self.first,
            "u": self.u.tolist(),
            "y": self.y.tolist(),
        }

    def proof(self) -> Json:
        """The weights."""
        return {"energy": self.energy.tolist(), "peak": self.peak.tolist()}


def falsifications(
    model: StableModel, funnel: TubeFunnel, y: FloatArray, u: FloatArray, begins: int = 0
) -> Iterator[Falsification]:
    """Candidates in the samples of one run, the shortest windows first for each place they end.

    y (N, p), u (N, n_u): consecutive samples, the first being number `begins` of its recording; y
    is NaN where nobody measured. Raises DataError for models that are not affine in their states.
    """
    refuse_unfalsifiable(model)
    for number, tube in enumerate(funnel.tubes, 1):
        if tube.samples is not None:
            continue
        g = np.ones(len(u)) if tube.follows is None else tube.follows.along(u)[:, 0]
        for end, measured in _broken(model, tube, y, u, g):
            stepper = Stepper(model)
            least = max(2, -(-(stepper.order + 1) // len(stepper.y)))
            first = measured + stepper.lags
            for length in _lengths(least, end + 1 - first):
                a = end + 1 - length
                weights = _weights(model, tube, y, u, g, a, end)
                if weights is None:
                    continue
                run = 0 if tube.follows is not None else a - stepper.delays
                yield Falsification(
                    number, begins + run, begins + a, u[run : end + 1], y[a : end + 1], *weights
                )


def refuse_unfalsifiable(model: object) -> None:
    """DataError for models that are not affine in their states."""
    if not isinstance(model, AFFINE):
        raise DataError(
            "samples are held against every state of an observer only for models that are affine "
            f"in it, linear and state_affine ones; this is a {type(model).__name__}"
        )


def _lengths(least: int, most: int) -> list[int]:
    """A few window lengths, growing by a half."""
    found = []
    while least <= most:
        found.append(least)
        least = max(least + 1, least * 3 // 2)
    return [*found, most] if found and found[-1] < most else found


def _broken(
    model: StableModel, tube: Tube, y: FloatArray, u: FloatArray, g: FloatArray
) -> list[tuple[int, int]]:
    """Samples where an observer from the run's start breaks a bound, with the first of its stretch.

    Only there can a window end: any state leaves at least what the best one does. ENDS at most.
    """
    stepper = Stepper(model)
    found, since, x, spent = [], 0, None, 0.0
    for k in range(len(y)):
        if not (np.isfinite(y[k]).all() and np.isfinite(u[k]).all()):
            since, x = k + 1, None
            continue
        if x is None:
            if k + 1 - since < stepper.lags:
                continue
            x, spent = stepper.begin(y[since : k + 1], u[since : k + 1])[None], 0.0
            continue
        try:
            out, x = stepper.advance(x, u[k])
        except (DataError, SolverError):  # an input that the model refuses
            since, x = k + 1, None
            continue
        e = y[k] - out[0]
        x = x + tube.L @ e
        q = float(e @ tube.R @ e)
        spent = tube.rho * spent + q
        over = spent > tube.level * g[k]
        if tube.peak is not None:
            over = over or q > tube.peak.level * max(1.0, g[k])
        if over:
            found.append((k, since))
    return found[:: max(1, -(-len(found) // ENDS))]


def _weights(
    model: StableModel, tube: Tube, y: FloatArray, u: FloatArray, g: FloatArray, a: int, end: int
) -> tuple[FloatArray, FloatArray] | None:
    """(energy, peak) for the window a … end that no state keeps; None if none were found."""
    rows, offsets = _innovations(model, tube, y, u, a, end)
    T = end + 1 - a
    factor = np.linalg.cholesky(tube.R).T
    rows, offsets = factor @ rows, offsets @ factor.T
    # Every bound as a row over q: E after sample k, then a single q, each divided by its level.
    ages = np.arange(T)[:, None] - np.arange(T)
    bounds = np.where(ages >= 0, tube.rho ** np.maximum(ages, 0), 0.0)
    bounds /= (tube.level * g[a : end + 1])[:, None]
    if tube.peak is not None:
        single = np.diag(1.0 / (tube.peak.level * np.maximum(1.0, g[a : end + 1])))
        bounds = np.vstack([bounds, single])
    last = np.zeros(len(bounds))
    last[T - 1] = 1.0  # the energy after the last sample alone is the simplest certificate
    for omega in (last, np.full(len(bounds), 1.0 / len(bounds))):
        for _ in range(ROUNDS):
            root = np.sqrt(omega @ bounds)[:, None]
            A, b = (root[..., None] * rows).reshape(-1, rows.shape[2]), (root * offsets).ravel()
            x = np.linalg.lstsq(A, b, rcond=None)[0]
            z = bounds @ ((offsets - rows @ x) ** 2).sum(axis=1)
            value = float(omega @ z)
            if value > 1.0 + ROOM:
                places = np.arange(len(omega))
                found = np.zeros(2 * T)
                found[: len(omega)] = omega * bounds[places, places % T]
                found /= found.max()
                return found[:T], found[T:]
            if not value > 0.0:
                break
            omega = omega * z / value
    return None


def _innovations(
    model: StableModel, tube: Tube, y: FloatArray, u: FloatArray, a: int, end: int
) -> tuple[FloatArray, FloatArray]:
    """(O (T, p, n), r (T, p)): e_k = r_k - O_k x̂ for the observer's state x̂ at sample a."""
    stepper = Stepper(model)
    n = stepper.order
    past = slice(a - stepper.lags, a)
    stepper.begin(np.nan_to_num(y[past]), u[past])
    states: FloatArray = np.vstack([np.zeros(n), np.eye(n)])
    rows, offsets = [], []
    for k in range(a, end + 1):
        out, states = stepper.advance(states, u[k])
        e = y[k] - out
        states = states + e @ tube.L.T
        offsets.append(e[0])
        rows.append((e[0] - e[1:]).T)
    return np.array(rows), np.array(offsets)
