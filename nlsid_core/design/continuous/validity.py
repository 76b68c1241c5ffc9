"""Where dynamics are valid: half-spaces around the motion, and the largest ρ within them."""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from nlsid_core.policies.continuous import ContinuousPolicy

CAP_ROOM = 1 - 1e-6  # the checker decides in rationals what is rounded here


def validity_rows(
    field: VectorField, policy: ContinuousPolicy, widths: FloatArray | None = None
) -> list[FloatArray]:
    """Per knot (R, n): |r'x̄| ≤ 1 keeps x and u where the dynamics are valid, for every row r.

    widths: (K-1, m) that the applied input is off.
    Raises DataError if the nominal itself does not keep to it.
    """
    found: list[list[FloatArray]] = [[] for _ in policy.t]
    clipped = {int(i) + field.n: (low, high) for i, low, high in policy.limits.tolist()}
    for k in range(len(policy.t) - 1):
        for entry, low, high in field.validity(field.span(float(policy.t[k]))):
            centre, rows = policy.entry(entry, k)
            least, most = clipped.get(entry, (-np.inf, np.inf))
            if most < low or high < least:
                raise DataError(
                    f"the limits [{least:g}, {most:g}] of input {entry - field.n} lie outside "
                    f"where its dynamics are valid, [{low:g}, {high:g}]"
                )
            # A limit within the bounds keeps its side by itself.
            room = min(
                np.inf if most <= high else high - float(np.max(centre)),
                np.inf if low <= least else float(np.min(centre)) - low,
            )
            if widths is not None and entry >= field.n:
                room -= float(widths[k, entry - field.n])
            if room <= 0:
                raise DataError(
                    f"the nominal leaves where its dynamics are valid: entry {entry} of (x, u) is "
                    f"{centre[0]:.4g} at {policy.t[k]:g} s, not well within [{low:g}, {high:g}]"
                )
            for knot in (k, k + 1) if np.isfinite(room) else ():
                found[knot] += list(rows / (CAP_ROOM**0.5 * room))
    return [np.array(rows).reshape(-1, field.n) for rows in found]


def validity_caps(
    field: VectorField, policy: ContinuousPolicy, P: FloatArray, widths: FloatArray | None = None
) -> FloatArray:
    """(K,) the largest ρ at each knot with which x and u stay where the dynamics are valid."""
    caps = np.empty(len(P))
    for knot, rows in enumerate(validity_rows(field, policy, widths)):
        reach = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(P[knot]), rows)
        caps[knot] = 1 / reach.max() if reach.any() else np.inf
    return caps
