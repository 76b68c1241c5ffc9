"""`identify_trapezoidal`: the implicit model of a mechanism from repeats of the same excitations.

The acceleration is a polynomial; one step is its mean over both ends, so that the model is linear
in its coefficients and the discretisation's error does not end up in them. Instruments as in
`identification.states`.
"""

from collections.abc import Sequence

import numpy as np

from nlsid_core._types import FloatArray
from nlsid_core.errors import DataError
from nlsid_core.identification.states import features, monomials_of, refuse_unequal
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.trajectory import Dataset


def identify_trapezoidal(train: Dataset, *, degrees: Sequence[int]) -> TrapezoidalModel:
    """Fit v⁺ - v = h/2 [a(q, v, u) + a(q⁺, v⁺, u)]; trajectories hold [q; v] in y.

    degrees: the highest power of each of [q; v; u]. Raises DataError if there are no repeats or the
    excitation does not determine the coefficients.
    """
    groups = list(train.repeats().values())
    if not groups:
        raise DataError("no excitation was repeated; record each at least twice, same inputs")
    exponents = monomials_of(degrees)
    every = np.concatenate([np.hstack([trial.y, trial.u]) for trial in train])
    scale, joints = np.abs(every).max(axis=0), groups[0][0].y.shape[1] // 2
    moments = np.zeros((len(exponents), len(exponents)))
    target = np.zeros((len(exponents), joints))
    for members in groups:
        refuse_unequal(members)
        total = np.sum([member.y for member in members], axis=0)
        for member in members:
            others = (total - member.y) / (len(members) - 1)
            instruments, regressors = (
                _means(
                    features(exponents, np.hstack([y[:-1], member.u[:-1]]) / scale),
                    features(exponents, np.hstack([y[1:], member.u[:-1]]) / scale),
                )
                for y in (others, member.y)
            )
            moments += instruments.T @ regressors
            target += instruments.T @ np.diff(member.y[:, joints:], axis=0)
    theta, _, rank, _ = np.linalg.lstsq(moments, target, rcond=None)
    if rank < len(exponents):
        raise DataError(
            f"the excitation determines {rank} of {len(exponents)} monomials; excite more, or "
            "lower the degrees"
        )
    rates = every[:, joints : 2 * joints]
    return TrapezoidalModel(
        exponents=exponents,
        coefficients=theta / train.period / np.prod(scale**exponents, axis=1)[:, None],
        period=train.period,
        rate_range=np.stack([rates.min(axis=0), rates.max(axis=0)], axis=1),
    )


def _means(now: FloatArray, later: FloatArray) -> FloatArray:
    return np.asarray((now + later) / 2)
