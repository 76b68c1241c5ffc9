"""The part of a design that is drawn: its signals' names, and how wide the tube is."""

from typing import Any

import numpy as np

from nlsid_core.designs import AnyDesign
from nlsid_core.funnels import ContinuousFunnel
from nlsid_core.running.reading import Reading


def signal_names(design: AnyDesign) -> tuple[str, ...]:
    """Names of the measured signals, with their units."""
    return tuple(f"{s.name} [{s.unit}]" if s.unit else s.name for s in design.signals[0])


class HalfWidths:
    """The most that each measured signal can be off the nominal, in its unit."""

    def __init__(self, design: AnyDesign) -> None:
        self._period, funnel = design.period, design.funnel
        if isinstance(funnel, ContinuousFunnel):
            stages: list[Any] = [stage.funnel for stage in design.stages]
            last = stages[-1].tf
            steps = np.arange(round((last - funnel.t0) / self._period) + 1) * self._period
            on = ((t, sum(t >= s.tf for s in stages[:-1])) for t in (funnel.t0 + steps).tolist())
            rows = [stages[i].widths(min(t, last)) for t, i in on]
        else:  # of every sample, or of all
            rows = list(np.atleast_2d(funnel.half_widths))
        self._rows = [tuple(map(float, row)) for row in rows]

    def of(self, reading: Reading) -> dict[str, float]:
        """Numbers by name, at a reading; of several signals with their index."""
        place = min(max(round(reading.t / self._period), 0), len(self._rows) - 1)
        row = tuple(reading.half_widths) or self._rows[place]
        if len(row) == 1:
            return {"half_width": row[0]}
        return {f"half_width[{i}]": width for i, width in enumerate(row)}
