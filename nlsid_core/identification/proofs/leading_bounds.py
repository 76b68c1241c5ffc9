"""Bounds of a quadratic leading coefficient G_0 on the box of the inputs, by the S-procedure."""

import numpy as np

from nlsid_core.arrays import FloatArray, IntArray
from nlsid_core.identification.methods.inequalities import MatrixInequality, minimise_linear
from nlsid_core.models import StateAffineModel

BOUNDS_GAP = 1e-6  # relative to |G_0|, how tightly its bounds are found
BOUND_ROOM = 1e-9  # the bounds are this much wider than found, so that they are strict


def leading_bounds(
    model: StateAffineModel,
) -> tuple[tuple[float, float], tuple[FloatArray, FloatArray]] | None:
    """(ℓ, h) with ℓ ≤ G_0 ≤ h on the input box, and the multipliers of each; None if ℓ ≤ 0."""
    box, (exponents, values) = model.window_range(), (model.G[0].exponents, model.G[0].coefficients)
    q = values[:, 0, 0]
    size, n_w = float(abs(q).sum()), len(box)
    ends, multipliers = [], []
    half_widths = 0.25 * (box[:, 1] - box[:, 0]) ** 2
    corner = float(abs(q) @ np.prod(np.maximum(1.0, abs(box).max(axis=1)) ** exponents, axis=1))
    for part, sign, column in zip(
        box_inequalities(exponents, box), (1.0, -1.0), (0, 1), strict=True
    ):
        fixed = np.tensordot(q, part[: len(q)], axes=1)
        columns = part[len(q) :][[column, *range(2 + column * n_w, 2 + (column + 1) * n_w)]]
        bound = MatrixInequality(np.concatenate([[fixed], columns]))
        signs = np.zeros((2 + n_w, n_w, n_w))
        signs[2 + np.arange(n_w), np.arange(n_w), np.arange(n_w)] = 1.0
        # Inside: large multipliers dominate q's curvature, a very wide bound pays for them.
        weight = 4.0 * corner * (1.0 + 1.0 / half_widths)
        start = np.concatenate([[0.0], weight])
        wide = bound.at(start)
        start[0] = -sign * (10.0 * float(abs(wide).sum()) * (1.0 + corner))
        objective = np.zeros(1 + n_w)
        objective[0] = -sign
        z = minimise_linear(
            objective, (bound, MatrixInequality(signs)), start, gap=BOUNDS_GAP * size
        )
        ends.append(float(z[0]) - sign * BOUND_ROOM * size)
        multipliers.append(z[1:])
    if ends[0] <= 0.0:
        return None
    return (ends[0], ends[1]), (multipliers[0], multipliers[1])


def box_inequalities(exponents: IntArray, box: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Matrices in [1; w] of q - ℓ - Σ a_i (w_i - lo_i)(hi_i - w_i) and of the same for h - q.

    Linear in [q's coefficients; ℓ; h; a; b]: two arrays (n_q + 2 + 2 n_w, n_w + 1, n_w + 1).
    """
    n_q, n_w = len(exponents), len(box)
    parts = []
    for end, sign in ((0, 1.0), (1, -1.0)):
        F = np.zeros((n_q + 2 + 2 * n_w, n_w + 1, n_w + 1))
        for index, powers in enumerate(exponents):
            used = [i + 1 for i, power in enumerate(powers) for _ in range(int(power))]
            i, j = [0] * (2 - len(used)) + used
            F[index, i, j] += 0.5 * sign
            F[index, j, i] += 0.5 * sign
        F[n_q + end, 0, 0] = -sign
        for i, (low, high) in enumerate(box, 1):
            entry = F[n_q + 2 + end * n_w + i - 1]
            entry[0, 0], entry[i, i] = low * high, 1.0
            entry[0, i] = entry[i, 0] = -0.5 * (low + high)
        parts.append(F)
    return parts[0], parts[1]
