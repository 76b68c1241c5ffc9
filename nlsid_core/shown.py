"""How results look in a terminal and in a notebook: tables, and small pictures of lines."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from nlsid_core.arrays import FloatArray

POINTS: Final = 80  # of a line
LEAST, MOST = 10, 35  # characters of a column, and lines of a table that are printed
BLUE, GREY = "#1f6fb4", "#9aa0a6"


@dataclass(frozen=True, repr=False)
class Table:
    """Numbers that have names; it prints as a table.

    columns: the name of each number of a row. rows: the numbers by the name of their row.
    """

    columns: tuple[str, ...]
    rows: Mapping[str, tuple[float, ...]]

    def __getitem__(self, row: str) -> float:
        """Give the last number of a row."""
        return self.rows[row][-1]

    def __repr__(self) -> str:
        first = max(map(len, self.rows), default=0)
        widths = [max(len(column), LEAST) for column in self.columns]
        texts = {name: [f"{x:.4g}" for x in numbers] for name, numbers in self.rows.items()}
        lines = [
            "  ".join([f"{name:{first}s}", *map(str.rjust, cells, widths)])
            for name, cells in ({"": self.columns} | texts).items()
        ]
        more = f"\n... {len(lines) - MOST} more in .rows" * (len(lines) > MOST)
        return "\n".join(lines[:MOST]) + more


def card(text: str, *lines: str) -> str:
    """Make HTML of a text and, below it, of lines in one picture of 600 x 100."""
    drawn = f'<svg viewBox="0 0 600 100" width="600" height="100">{"".join(lines)}</svg>'
    return f"<div><pre>{escape(text)}</pre>{drawn if lines else ''}</div>"


def line(t: FloatArray, values: FloatArray, colour: str, span: FloatArray | None = None) -> str:
    """Draw values (N,) over t (N,), from the least to the largest of `span` (None: of values)."""
    low, high = (f(values if span is None else span) for f in (np.nanmin, np.nanmax))
    rows = np.linspace(0, len(t) - 1, min(len(t), POINTS)).astype(int)
    across = 600.0 * (t[rows] - t[0]) / (np.ptp(t) or 1.0)
    up = 95.0 - 90.0 * (values[rows] - low) / ((high - low) or 1.0)
    points = " ".join(f"{x:.0f},{y:.0f}" for x, y in zip(across, up, strict=True))
    return f'<polyline points="{points}" fill="none" stroke="{colour}"/>'
