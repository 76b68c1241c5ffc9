"""ρ(t) with a hold, and with it how far held inputs are off: together, backward in time.

How far they are off depends on the funnel, and the funnel on that. A sweep knows the end of an
interval when it comes to it, and a funnel's size changes little on one interval: so inputs are
taken to be off there as in a copy of the funnel without a hold that is as large as the end.
Nothing is claimed of what is found: it says in which funnel rates are worth bounding.
Source: docs/theory-funnels.md, "The hold between samples".
"""

from dataclasses import replace

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.expansion import Expansion
from nlsid_core.design.continuous.held import Changes, Hold, fastest
from nlsid_core.design.continuous.lstep import LSteps, Section
from nlsid_core.design.continuous.setting import Setting
from nlsid_core.design.continuous.sweep import swept, wanted_of
from nlsid_core.dynamics.taylor import field_of
from nlsid_core.dynamics.vector_field import VectorField
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.progress import Progress, silent
from nlsid_core.sos.sphere import SphereSolution

SIZES = np.array([0.03, 0.25, 0.5, 0.75, 1.0])  # of half-widths: between them W is nearly linear
EXPANDED = (1.0, 0.5, 0.25)  # of these: copies of the free funnel with cubics of their own
MOST_BACK = 2  # of ρ at an interval's end: where inputs push too much, a smaller one is no help


class HeldSteps(LSteps):
    """L-steps whose widths follow ρ, and which solve what decides: no more than a sweep asks.

    free: (K,) ρ without a hold. table: (SIZES, intervals, m) widths in copies of that funnel.
    """

    def __init__(
        self, steps: LSteps, setting: Setting, free: FloatArray, table: FloatArray
    ) -> None:
        super().__init__(
            steps.field,
            setting.policy,
            nonlinear=steps.nonlinear,
            pushed=steps.pushed,
            widths=table[-1].copy(),
        )
        self.tightness = steps.tightness
        self.free, self.table = free, table

    def bound_pushes(self, section: Section, rho: float) -> None:
        """κ, and the widths of the section's interval, for what is off where W = ρ."""
        super().bound_pushes(section, rho)
        assert self.widths is not None  # set above
        k = section.interval
        size = np.sqrt(rho / self.free[k + 1])
        self.widths[k] = [np.interp(size, SIZES, column) for column in self.table[:, k].T]

    def solve(
        self,
        section: Section,
        rho: float,
        start: list[SphereSolution] | None = None,
        *,
        least: float = -np.inf,
        enough: float = np.inf,
    ) -> list[SphereSolution]:
        """φ for the cases that `start` does not bound above one that is solved; else that bound."""
        del enough  # of what decides, all is
        if start is None:
            return super().solve(section, rho)
        bounds = self.bounds(section, rho, start, range(self.cases))
        found = [replace(s, m=bound) for s, bound in zip(start, bounds, strict=True)]
        lowest = np.inf
        for case in np.argsort(bounds, kind="stable").tolist():
            if bounds[case] >= lowest or lowest < least:
                break
            found[case] = self.solved_case(section, rho, case, start[case])
            self.solved += 1
            lowest = min(lowest, found[case].m)
        return found


def with_widths(setting: Setting, field: VectorField) -> LSteps:
    """The setting's L-steps, of this field, with what an input is off: nothing yet."""
    policy = replace(setting.policy, vector_field=files.digest(field.document()))
    return setting.steps.like(field, policy, np.zeros((len(policy.t) - 1, field.m)))


def changes_by_size(setting: Setting, expansion: Expansion | None) -> dict[float, Changes]:
    """dũ/dt in the free funnel, and in smaller copies where these have cubics of their own.

    A key is a copy's half-widths over those of the free funnel.
    """
    assert setting.hold is not None  # a search for a hold begins with what is found without one
    free, policy, P = setting.hold.free, setting.policy, setting.P
    found = {}
    for size in (1.0,) if expansion is None else EXPANDED:
        rho, field = size**2 * free, setting.steps.field
        if expansion is not None and size < 1:
            cubics = [
                expansion.around(policy, P, k, (rho[k], rho[k + 1])) for k in range(len(P) - 1)
            ]
            field = field_of(cubics, policy.t)
        outer = ContinuousFunnel(policy.x, P, rho, "", "")
        found[size] = Changes.of(with_widths(setting, field), outer)
    return found


def widths_by_size(changes: dict[float, Changes], setting: Setting, hold: Hold) -> FloatArray:
    """(SIZES, intervals, m) W in copies of the free funnel; without `changes` all is one."""
    policy, found = setting.policy, []
    for size in SIZES.tolist():
        least = min((known for known in changes if known >= size), default=None)
        if least is None:
            found.append(hold.widths(policy, np.zeros((len(policy.t) - 1, setting.steps.field.m))))
        else:
            found.append(fastest(changes[least], policy, hold, size / least)[1])
    return np.array(found)


def held_sweep(
    setting: Setting,
    expansion: Expansion | None,
    table: FloatArray,
    caps: FloatArray,
    progress: Progress = silent,
) -> tuple[FloatArray, VectorField]:
    """ρ (K,) that may be expected with this hold, and the field for it, expanded around it.

    table: see `HeldSteps`. caps: (K,) that ρ keeps below. Raises Infeasible.
    """
    assert setting.hold is not None  # a search for a hold begins with what is found without one
    steps = HeldSteps(setting.steps, setting, setting.hold.free, table)
    if expansion is not None:
        steps.field = expansion.linear()
    expanded = replace(setting, steps=steps, expansion=expansion)
    found = swept(expanded, wanted_of(setting, caps), progress, most_back=MOST_BACK)
    return found.rho, found.setting.steps.field
