"""Dynamics that are not polynomial, expanded anew on each interval around what the funnel needs."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from traceback import extract_tb

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.dynamics import Nominal
from nlsid_core.dynamics.taylor import Cubic, Rates, field_of
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.policies.continuous import ContinuousPolicy

ROOM = 1 + 1e-6  # of the box over the funnel: the checker decides in rationals
LINEAR = 1e-3  # of a box's size: there a cubic is as good as the derivative
LOWEST = 1e-9  # of ρ at the right end: below, there is no funnel worth the name
BACK = 0.8  # of ρ, where a box is too wide, or the interval before cannot take it
HALVINGS = 6  # of an interval on which the motion's own box is too wide: then it is not the box
PACKAGE = Path(__file__).parents[2]  # lines of code outside are those of who wrote the equations


@dataclass(frozen=True, eq=False)
class Expansion:
    """rates along `nominal`: expands them on any interval and any box around the motion."""

    rates: Rates
    nominal: Nominal
    near: dict[int, Cubic] = field(default_factory=dict)

    def on(self, k: int, reach: FloatArray, limits: FloatArray | None = None) -> Cubic:
        """The cubics on interval k for (x, u) within reach (n + m,) of the motion's range."""
        x, u = self.nominal.x.control[k], self.nominal.u.control[k]
        low = np.concatenate([x.min(axis=0), u.min(axis=0)]) - reach
        high = np.concatenate([x.max(axis=0), u.max(axis=0)]) + reach
        for i, least, most in [] if limits is None else limits.tolist():
            j = self.rates.n + int(i)
            low[j], high[j] = max(low[j], least), min(high[j], most)
        return self._expanded(low, high, k)

    def _expanded(self, low: FloatArray, high: FloatArray, k: int) -> Cubic:
        t = self.nominal.t
        try:
            return self.rates.on(low, high, (float(t[k]), float(t[k + 1])))
        except (DataError, OverflowError, ZeroDivisionError) as error:
            raise NoExpansion(self, low, high, k, error) from error

    def linear(self) -> VectorField:
        """The field to linearise: expanded close to the motion, of no use anywhere else."""
        cubics = [self._close(k) for k in range(len(self.nominal.t) - 1)]
        return replace(field_of(cubics, self.nominal.t), valid=self.rates.valid)

    def _close(self, k: int) -> Cubic:
        """The cubics on interval k close to the motion; the same whenever it is asked."""
        if k not in self.near:
            self.near[k] = self.on(k, self._near())
        return self.near[k]

    def _near(self) -> FloatArray:
        """(n + m,) so far from the motion a cubic is as good as the derivative."""
        size = np.hstack([self.nominal.x.ends(), self.nominal.u.ends()])
        return np.asarray(LINEAR * np.maximum(np.ptp(size, axis=0), LINEAR))

    def refined(self, most: int) -> "Expansion":
        """Around the motion with knots, `most` in all, where it has no cubics as it is."""
        found = self
        for _ in range(HALVINGS):
            coarse = []
            for k in range(len(found.nominal.t) - 1):
                try:
                    found._close(k)
                    coarse.append(False)
                except NoExpansion:
                    coarse.append(True)
            if not any(coarse) or len(coarse) + 1 + sum(coarse) > most:
                break
            found = Expansion(self.rates, found.nominal.halved(coarse))
        return found

    def nonlinear_states(self) -> tuple[int, ...]:
        """The states that enter nonlinearly on some interval."""
        reach = np.full(self.rates.n + self.rates.m, LINEAR**2)
        found = [set(self.on(k, reach).nonlinear_states()) for k in (0, len(self.nominal.t) - 2)]
        return tuple(sorted(set.union(*found)))

    def room(self, policy: ContinuousPolicy, P: FloatArray, k: int, after: float) -> float:
        """The share of ρ = `after` at the end of interval k with which there are cubics on it.

        1, or a power of BACK. Raises NoExpansion where the motion's own box is too wide.
        """
        share = 1.0
        while True:
            try:
                self.around(policy, P, k, (LOWEST * after, share * after))
                return share
            except NoExpansion:
                if share < LOWEST:
                    raise
                share *= BACK

    def around(
        self,
        policy: ContinuousPolicy,
        P: FloatArray,
        k: int,
        rho: tuple[float, float],
        held: FloatArray | None = None,
    ) -> Cubic:
        """The cubics on interval k on a box that holds the funnel with these ρ at its knots.

        held: (m,) by how much more the inputs may be off.
        """
        reach = np.zeros(self.rates.n + self.rates.m)
        for knot, level in zip((k, k + 1), rho, strict=True):
            inverse = level * np.linalg.inv(P[knot])
            states = np.diag(inverse)
            gains = policy.K.control[k]
            inputs = np.einsum("dij,jk,dik->di", gains, inverse, gains).max(axis=0, initial=0.0)
            reach = np.maximum(reach, np.concatenate([states, inputs]))
        reach = np.sqrt(reach)
        if held is not None:
            reach[self.rates.n :] += held
        return self.on(k, ROOM * reach, policy.limits)


class NoExpansion(Infeasible):
    """No cubics on a box: when, in which line of the equations, and which entries are too wide."""

    def __init__(
        self, expansion: Expansion, low: FloatArray, high: FloatArray, k: int, cause: Exception
    ) -> None:
        self.expansion, self.low, self.high, self.k, self.cause = expansion, low, high, k, cause

    def __str__(self) -> str:
        rates, t = self.expansion.rates, self.expansion.nominal.t
        frames = extract_tb(self.cause.__traceback__)
        own = [f for f in frames if PACKAGE not in Path(f.filename).parents and f.line]
        place = f", in `{own[-1].line}`" if own else ""
        wide = [
            f"{'x' if j < rates.n else 'u'}{j if j < rates.n else j - rates.n} in "
            f"[{self.low[j]:.3g}, {self.high[j]:.3g}]"
            for j in rates.expanded
            if self._narrower(j)
        ]
        if isinstance(self.cause.__cause__, TypeError):  # whatever the box is
            why = "whatever the state and the input are"
        elif not wide:
            why = "and no single state or input is the cause: the equations are not smooth there"
        else:
            why = f"because of {' or '.join(wide)}"
        return (
            f"the equations cannot be expanded between {t[self.k]:.6g} and {t[self.k + 1]:.6g} s: "
            f"{self.cause}{place}, {why}"
        )

    def _narrower(self, j: int) -> bool:
        """Whether the equations can be expanded where entry j of (x, u) is in its middle."""
        low, high = self.low.copy(), self.high.copy()
        low[j] = high[j] = (low[j] + high[j]) / 2
        t = self.expansion.nominal.t
        try:
            self.expansion.rates.on(low, high, (float(t[self.k]), float(t[self.k + 1])))
        except (DataError, OverflowError, ZeroDivisionError):
            return False
        return True
