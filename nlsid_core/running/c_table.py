"""A linear tube's numbers as a C file: what `examples/rclcpp_monitor` reads in place of JSON.

Its core does what `TubeRun` does with these float64, which are written in hexadecimal.
"""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from nlsid_core import files
from nlsid_core.designs import AnyDesign
from nlsid_core.errors import DataError
from nlsid_core.funnels.tube import TubeFunnel
from nlsid_core.kernel import Verdict
from nlsid_core.models import DifferenceEquation
from nlsid_core.running.forecast import linear_form
from nlsid_core.running.tubes import Limits

MOST_ORDER, MOST_TUBES = 32, 4  # as in nlsid_monitor.h
# Where a number is, by which clock its times are, and for how long it is held.
_PLAIN = re.compile(r"[^|*]*(\|(clock|hold)\([^|]*\))*")


def write_table(design: AnyDesign, path: Path) -> Verdict:
    """Write a proved design's table to a C file; its verdict. Raises as `c_table`."""
    table = c_table(design.model, design.funnel)
    files.write_atomically(path, table.encode())
    return design.verdict


def c_table(model: object, funnel: object) -> str:
    """Make C that defines `nlsid_table`.

    Raises DataError for any design but a tube of constant width around a linear model of one output
    and one input.
    """
    if not isinstance(model, DifferenceEquation) or not isinstance(funnel, TubeFunnel):
        raise DataError(
            "the C monitor is for tubes around a linear model of one output and one input; the "
            "node funnel_monitor is for all"
        )
    n, linear = len(model), linear_form(model)
    assert linear is not None
    hidden = np.array([linear.carried @ linear.rounded(unit) for unit in np.eye(n)])
    if not all(map(_PLAIN.fullmatch, (model.y.path, model.u.path))):
        raise DataError(
            f"the C monitor reads numbers as they are, and these have operations: {model.y.path}, "
            f"{model.u.path}"
        )
    fits = n <= MOST_ORDER and len(funnel.tubes) <= MOST_TUBES and funnel.settling == n
    if not fits or any(tube.follows for tube in funnel.tubes) or not np.isfinite(hidden).all():
        raise DataError(
            f"the C monitor is for at most {MOST_ORDER} lags, which start a run, of a model that "
            f"forgets, and at most {MOST_TUBES} tubes that are as wide always: design it with "
            "`funnel: {level: constant}`"
        )
    tubes = []
    for tube in funnel.tubes:
        of = Limits.of(tube)
        numbers = of.rho, of.R[0][0], of.up, of.level, of.peak[0], of.widths[0]
        tubes.append(f"  {{{_row(numbers)}, {tube.samples or 0}, {_array(tube.L[:, 0])}}},")
    rows = model.a, model.b, model.B[:, 0], model.offset, hidden[:, 0]
    signals = [f"{each.name} [{each.unit}] at {each.path}" for each in (model.y, model.u)]
    said = f"{signals[0]} from {signals[1]}, every {model.period!r} s".replace("*/", "* /")
    return "\n".join(
        [
            f"/* The tube around {said} */",
            '#include "nlsid_monitor.h"',
            "#include <math.h>",
            "static const nlsid_tube tubes[] = {",
            *tubes,
            "};",
            "const nlsid_design nlsid_table = {",
            f"  {n}, {len(tubes)}, {_row([model.period, model.c, model.D])},",
            *(f"  {_array(row)}," for row in rows),
            "  tubes,",
            "};\n",
        ]
    )


def _row(numbers: Iterable[float]) -> str:
    """Hexadecimal, so that C reads the same float64."""
    return ", ".join(float(number).hex().replace("inf", "INFINITY") for number in numbers)


def _array(numbers: Iterable[float]) -> str:
    return f"(const double[]){{{_row(numbers)}}}"
