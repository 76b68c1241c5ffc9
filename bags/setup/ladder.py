"""What is tried for recordings, in which order; the one rule (`choosing`) takes what is best.

It is a list, cheap first: linear models, what bends them, networks, then the best of them with more
or fewer lags, higher degrees, one step in place of several, and a shorter memory.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from nlsid_core.data.trajectory import Dataset
from nlsid_core.errors import DataError
from nlsid_core.identification.choosing import Attempt, Choice, HeldOut, Row
from nlsid_core.identification.methods.options import LeastSquares, Method, Rse, Sem
from nlsid_core.identification.network.options import (
    CellRow,
    Feedback,
    FilterMapFilter,
    Follower,
    Limit,
    Network,
)
from nlsid_core.identification.polynomial.options import Degrees, Polynomial
from nlsid_core.identification.polynomial.rows import build_state_affine_rows
from nlsid_core.identification.rates import rate_of_memory
from nlsid_core.progress import Progress, silent

LAGS = (1, 2, 3, 4, 6, 8, 10)  # of one input and output
FEW_LAGS = (1, 2, 3, 4)
STEPS = 6  # of a search while it is one of many
MEMORIES = (1.0 / 3.0, 0.1)  # of the longest trial, beside all of it
EVERY = 100  # least squares is quick
DROPPED = 1.2  # times the best: what is worse on the first fold is not judged on the others
LEAP = 0.25  # of the error before: where filters or a follower leave less, no others are tried
MOST_FILTERED = 6  # states of filters: as many as lags of the best by least squares, or fewer
SWINGS = 10.0  # % of the spread, above which a loop through a map is tried, which takes longest
ENOUGH = 5.0  # % of the spread, below which nothing more curved is tried


def choose(
    held_out: HeldOut,
    stages: "Stages",
    known: Sequence[Row] = (),
    *,
    progress: Progress = silent,
) -> Choice:
    """Try what there is for such data: all on the first fold, the best of each stage on all.

    known: what was tried before. A stage sees what its own attempts gave on the first fold.
    """
    rows = list(known)
    for number, (stage, kept) in enumerate(stages):
        begun = len(rows)
        seen = list(rows)
        for attempt in stage(held_out.data, seen):
            if all(row.attempt != attempt for row in seen):
                progress(str(attempt), number / len(stages))
                seen.append(held_out.glance(attempt))
        for place, row in enumerate(sorted(seen[begun:], key=lambda row: row.percent)):
            best = least(rows)
            limit = DROPPED * (math.inf if best is None else best.percent)
            if row.refusal:
                rows.append(row)
            elif kept == EVERY or (place < kept and row.percent <= limit):
                progress(str(row.attempt), (number + 0.5) / len(stages))
                rows.append(held_out.judged(row))
            else:
                rows.append(replace(row, refusal=f"{row.percent:.3g} % on one fold"))
    return Choice(held_out, tuple(rows))


def tried(train: Dataset, stages: "Stages", *, progress: Progress) -> Choice | None:
    """Everything that was tried for these trials; None if they are too few to hold some out."""
    try:
        return choose(HeldOut.of(train), stages, progress=progress)
    except DataError:
        return None


def least(rows: Iterable[Row]) -> Row | None:
    """The row with the least error, if one has an error."""
    return min((row for row in rows if not row.refusal), key=lambda row: row.percent, default=None)


Stage = Callable[[Dataset, Sequence[Row]], Iterator[Attempt]]  # of the rows that are there by then


def linear(data: Dataset, _rows: Sequence[Row]) -> Iterator[Attempt]:
    """Try linear models by least squares."""
    for made in _linear_of(data, LAGS if signals_of(data) == (1, 1) else FEW_LAGS):
        yield Attempt(made, LeastSquares())


def iterated(data: Dataset, _rows: Sequence[Row]) -> Iterator[Attempt]:
    """Linear, by simulation error."""
    method: Method = Rse(STEPS) if signals_of(data)[0] == 1 else Sem(STEPS, certified=True)
    for made in _linear_of(data, FEW_LAGS):
        yield Attempt(made, method)


def _linear_of(data: Dataset, most: Sequence[int]) -> Iterator[Polynomial]:
    """With so many lags, of all inputs or of one sample of them."""
    for lags in most:
        yield Polynomial(lags)
        if signals_of(data)[1] > 1:
            yield from (Polynomial(lags, (k,)) for k in range(1, lags + 1))


def curved(data: Dataset, rows: Sequence[Row]) -> Iterator[Attempt]:
    """Polynomials of the inputs, factors of the outputs, increasing functions of the output."""
    best = least(rows)
    if best is None or best.percent < ENOUGH:
        return
    certified = Sem(STEPS, certified=True)
    lags = max(2, min(_lags(best), FEW_LAGS[-1]))
    for degree in (2, 3, 4):
        delays = excited(data, lags, degree)
        yield Attempt(Polynomial(lags, delays, Degrees(inputs=degree)), Rse(STEPS))
    for degrees in (Degrees(inputs=2, leading=1), Degrees(left=3, inputs=3)):
        delays = excited(data, lags, degrees.inputs)
        yield Attempt(Polynomial(lags, delays, degrees), certified)
    if signals_of(data)[0] == 1:
        yield Attempt(Polynomial(lags, degrees=Degrees(left=3)), certified)


def networks(data: Dataset, rows: Sequence[Row]) -> Iterator[Attempt]:
    """Filters around a map, with as many states as linear models need, followers, rows of cells.

    Until one of them explains most; else a loop through a map, which takes longest.
    """
    before = min((row.percent for row in rows), default=math.inf)
    if signals_of(data)[0] > 1 or not ENOUGH <= before < math.inf:
        return
    certified = Sem(STEPS, certified=True)
    for structure in _structures(data, rows):
        leapt = min(row.percent for row in rows) < LEAP * before
        if leapt and not isinstance(structure, FilterMapFilter):
            return
        yield Attempt(Network(structure), certified)
    if min(row.percent for row in rows) > SWINGS:
        yield Attempt(Network(Feedback(2, stages=2, imitated=20)), certified)


def _structures(
    data: Dataset, rows: Sequence[Row]
) -> Iterator[FilterMapFilter | Follower | CellRow]:
    if signals_of(data)[1] == 1:
        straight = least(row for row in rows if row.attempt.method == LeastSquares())
        n = 4 if straight is None else max(2, min(_lags(straight), MOST_FILTERED))
        for orders in dict.fromkeys(((n, 0), (0, n), (n - n // 2, n // 2))):
            yield FilterMapFilter(orders, intervals=12, starts=4)
        yield Follower()
    limits: tuple[tuple[int, Limit], ...] = ((1, "none"), (1, "friction"), (2, "top"))
    for cells, limit in limits:
        yield CellRow(cells, intervals=4, limit=limit)


def nearby(data: Dataset, rows: Sequence[Row]) -> Iterator[Attempt]:
    """The best with more or fewer lags, higher degrees or knots, and equations by one step."""
    best = least(rows)
    if best is None:
        return
    attempt = best.attempt
    if isinstance(made := attempt.model_class, Polynomial):
        for lags in (made.lags - 1, made.lags + 1, made.lags + 2):
            if lags >= 1:
                yield replace(attempt, model_class=replace(made, lags=lags))
        if made.degrees.leading:
            higher = replace(made.degrees, inputs=3, leading=2 if signals_of(data) == (1, 1) else 1)
            yield replace(attempt, model_class=replace(made, lags=made.lags - 1, degrees=higher))
    if isinstance(part := getattr(made, "structure", None), FilterMapFilter):
        one, two, three = (
            replace(attempt, model_class=Network(replace(part, phases=phases, intervals=intervals)))
            for phases, intervals in ((1, 24), (2, 24), (3, 48))
        )
        yield from (one, two)
        if rows[-1].percent < rows[-2].percent:
            yield three
    if isinstance(made, Polynomial) and isinstance(method := attempt.method, Rse | Sem):
        yield replace(attempt, method=replace(method, iterations=1))


def memories(data: Dataset, rows: Sequence[Row]) -> Iterator[Attempt]:
    """The best with a shorter memory than it has."""
    best = least(rows)
    if best is not None and best.attempt.method != LeastSquares():  # which knows no limit
        for memory in MEMORIES:
            if best.rate > rate_of_memory(data, memory):
                yield replace(best.attempt, memory=memory)


def _lags(row: Row) -> int:
    """The lags of an equation; 0 of a network."""
    made = row.attempt.model_class
    return made.lags if isinstance(made, Polynomial) else 0


def signals_of(data: Dataset) -> tuple[int, int]:
    """How many outputs and inputs there are."""
    first = data.trajectories[0]
    return first.y.shape[1], first.u.shape[1]


def excited(data: Dataset, lags: int, degree: int) -> tuple[int, ...] | None:
    """All delays (None) of one input, where it excites their products; else one delay."""
    if signals_of(data)[1] > 1:
        return (1,)
    try:
        build_state_affine_rows(data, Polynomial(lags, degrees=Degrees(inputs=degree)))
    except DataError:
        return (1,)
    return None


Stages = Sequence[tuple[Stage, int]]  # with how many of each are judged
LINEAR: Stages = ((linear, EVERY), (iterated, 3))
BEYOND: Stages = (
    (curved, 3),
    (networks, 2),
    (nearby, 2),
    (nearby, 2),  # once more, where that found a better one
    (memories, 1),
)
STAGES = (*LINEAR, *BEYOND)
