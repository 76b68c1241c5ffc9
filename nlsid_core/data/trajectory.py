"""Recorded or nominal motions: `Trajectory`, and `Dataset`, several of them on one time grid."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray
from nlsid_core.errors import DataError, ShapeError, counted
from nlsid_core.shown import BLUE, GREY, card, line

ROUNDING = 1e-5  # ns; a mean step this close to whole nanoseconds was not meant to differ from them
GRID_TOLERANCE = 1e-6  # relative; stamps are integer nanoseconds, so a grid repeats to far better


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Trajectory:
    """Signals of one motion on its own time stamps; arrays are checked once and read-only.

    t: (N,) s, strictly increasing. y: (N, n_y) responses. u: (N, n_u) excitations, held constant
    until the next sample.
    Names, units and paths (`topic:field`, empty: not from a topic) go with the columns. `group` is
    the same for repeats of one excitation (empty: not a repeat). `digest` names the recording it
    came from (empty: none), `provenance` is JSON text that says how it was read from it.

    Raises ShapeError on mismatched lengths, DataError on NaN or on time that does not increase.
    """

    t: FloatArray
    y: FloatArray
    u: FloatArray
    y_names: tuple[str, ...] = ()
    u_names: tuple[str, ...] = ()
    y_units: tuple[str, ...] = ()
    u_units: tuple[str, ...] = ()
    y_paths: tuple[str, ...] = ()
    u_paths: tuple[str, ...] = ()
    name: str = ""
    group: str = ""
    digest: str = ""
    provenance: str = ""

    def __post_init__(self) -> None:
        t = _frozen(self.t)
        if t.ndim != 1:
            raise ShapeError(f"{self._label}: t should have shape (N,), has {t.shape}")
        object.__setattr__(self, "t", t)
        for key in ("y", "u"):
            array = _frozen(getattr(self, key))
            array = array[:, None] if array.ndim == 1 else array
            if array.ndim != 2 or len(array) != len(t):
                raise ShapeError(
                    f"{self._label}: {key} should have {len(t)} rows, as t; has shape {array.shape}"
                )
            if not np.isfinite(array).all():
                row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
                raise DataError(f"{self._label}: {key} is {array[row]} at t = {t[row]:g} s")
            object.__setattr__(self, key, array)
        _check_time(t, self._label)
        self._fill_names("y", self.y.shape[1])
        self._fill_names("u", self.u.shape[1])

    def __len__(self) -> int:
        return len(self.t)

    def __repr__(self) -> str:
        signals = ", ".join((*self.y_names, *self.u_names))
        return f"<Trajectory {self._label}: {len(self)} samples of {signals}>"

    @property
    def period(self) -> float:
        """The sample time in s; DataError if the stamps are not on a uniform grid."""
        if len(self.t) < 2:
            raise DataError(f"{self._label}: {len(self.t)} sample; a sample time needs two")
        steps = np.diff(self.t)
        period = float(self.t[-1] - self.t[0]) / len(steps)
        if 0.0 < abs(1e9 * period - round(1e9 * period)) < ROUNDING < 1e9 * period:
            period = round(1e9 * period) / 1e9  # 0.1, not 0.09999999999999999
        worst = int(np.argmax(np.abs(steps - period)))
        if abs(steps[worst] - period) > GRID_TOLERANCE * period:
            raise DataError(
                f"{self._label}: not on a uniform grid: step {steps[worst]:.6g} s after "
                f"t = {self.t[worst]:g} s, on average {period:.6g} s"
            )
        return period

    def rows(self, part: slice, name: str | None = None) -> Trajectory:
        """These samples of it, called so (None: as it is)."""
        return replace(
            self,
            t=self.t[part],
            y=self.y[part],
            u=self.u[part],
            name=self.name if name is None else name,
        )

    @property
    def _label(self) -> str:
        return self.name or "trajectory"

    def _fill_names(self, letter: str, columns: int) -> None:
        defaults = {
            "names": tuple(f"{letter}{i}" for i in range(columns)),
            "units": ("",) * columns,
            "paths": ("",) * columns,
        }
        for key, default in defaults.items():
            given = tuple(getattr(self, f"{letter}_{key}")) or default
            if len(given) != columns:
                raise ShapeError(f"{self._label}: {letter} has {columns} columns, {key} {given}")
            object.__setattr__(self, f"{letter}_{key}", given)


@dataclass(frozen=True, eq=False, repr=False)
class Dataset:
    """Trajectories with the same signals and the same sample time; `group` marks repeats.

    Raises DataError if there are none or if signals or sample times differ.
    """

    trajectories: tuple[Trajectory, ...]
    period: float = field(init=False)

    def __post_init__(self) -> None:
        trajectories = tuple(self.trajectories)
        object.__setattr__(self, "trajectories", trajectories)
        if not trajectories:
            raise DataError("a dataset needs at least one trajectory")
        first = trajectories[0]
        object.__setattr__(self, "period", first.period)
        for other in trajectories[1:]:
            if (other.y_names, other.u_names) != (first.y_names, first.u_names):
                raise DataError(
                    f"{other.name}: signals {other.y_names + other.u_names}, "
                    f"but {first.name} has {first.y_names + first.u_names}"
                )
            if abs(other.period - first.period) > GRID_TOLERANCE * first.period:
                raise DataError(
                    f"{other.name}: sample time {other.period:.6g} s, "
                    f"but {first.name} has {first.period:.6g} s"
                )

    @classmethod
    def from_pandas(
        cls,
        frames: Mapping[str, Any] | Any,
        *,
        y: Sequence[str] | str,
        u: Sequence[str] | str,
        paths: Mapping[str, str] | None = None,
    ) -> Dataset:
        """Make a dataset of pandas DataFrames, one a trial, on one grid of time.

        Args:
            frames: a DataFrame, or several by the names of their trials. The index is the time,
                in s or as a DatetimeIndex; `frame` reads bags so, with a period.
            y: the columns of the responses, what is measured.
            u: the columns of the excitations, what drives the robot.
            paths: where a monitor finds columns in bags and on topics, such as
                {"speed": "/odom:twist.twist.linear.x"}. A column called `/topic:field` needs none.

        Returns:
            The dataset; its signals are called as the columns.

        Raises:
            DataError: on NaN, where a column is missing, where the index only counts the rows, and
                where they are not equally far apart in time.
        """
        trials = []
        y, u = ((one,) if isinstance(one, str) else tuple(one) for one in (y, u))
        topics = {name: name for name in (*y, *u) if name.startswith("/") and ":" in name}
        known = topics | dict(paths or {})
        for name, table in (frames if isinstance(frames, Mapping) else {"data": frames}).items():
            if missing := [str(column) for column in (*y, *u) if column not in table]:
                raise DataError(f"{name}: no column {missing[0]}; there are {list(table.columns)}")
            if table.index.name is None and type(table.index).__name__ == "RangeIndex":
                raise DataError(
                    f"{name}: the index only counts the rows; let it be the time, such as "
                    "table.set_index('t')"
                )
            t = table.index.to_numpy()
            if t.dtype.kind == "M":
                t = (t - t[0]) / np.timedelta64(1, "s")
            trials.append(
                Trajectory(
                    t=t,
                    y=table[list(y)],
                    u=table[list(u)],
                    y_names=y,
                    u_names=u,
                    y_paths=tuple(known.get(column, "") for column in y),
                    u_paths=tuple(known.get(column, "") for column in u),
                    name=name,
                )
            )
        return cls(tuple(trials))

    def __repr__(self) -> str:
        first = self.trajectories[0]
        return (
            f"<Dataset: {counted(len(self), 'trial')}, {sum(map(len, self))} samples of "
            f"{self.period:g} s, {', '.join(first.u_names)} -> {', '.join(first.y_names)}>"
        )

    def _repr_html_(self) -> str:
        """The same, and the first trial's first excitation and response, each over its range."""
        t, y, u = (getattr(self.trajectories[0], name) for name in "tyu")
        return card(repr(self), line(t, u[:, 0], GREY), line(t, y[:, 0], BLUE))

    def __len__(self) -> int:
        return len(self.trajectories)

    def __iter__(self) -> Iterator[Trajectory]:
        return iter(self.trajectories)

    @property
    def names(self) -> tuple[str, ...]:
        """The trajectories' names, in order."""
        return tuple(trajectory.name for trajectory in self.trajectories)

    @property
    def bags(self) -> tuple[tuple[str, str], ...]:
        """(name, digest of its recording) of every trajectory, as a model names them."""
        return tuple((trajectory.name, trajectory.digest) for trajectory in self.trajectories)

    def select(self, names: Sequence[str]) -> Dataset:
        """The named trajectories, in the order given; DataError names an unknown one."""
        known = {trajectory.name: trajectory for trajectory in self.trajectories}
        for name in names:
            if name not in known:
                raise DataError(f"no trajectory '{name}'; there are: {', '.join(known)}")
        return Dataset(tuple(known[name] for name in names))

    def without(self, names: Sequence[str]) -> Dataset:
        """All but the named trajectories."""
        return Dataset(tuple(t for t in self.trajectories if t.name not in set(names)))

    def repeats(self) -> dict[str, tuple[Trajectory, ...]]:
        """Trajectories that repeat one excitation, by group; groups of one are left out."""
        groups: dict[str, list[Trajectory]] = {}
        for trajectory in self.trajectories:
            if trajectory.group:
                groups.setdefault(trajectory.group, []).append(trajectory)
        return {group: tuple(members) for group, members in groups.items() if len(members) > 1}


def _frozen(values: ArrayLike) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _check_time(t: FloatArray, label: str) -> None:
    if not np.isfinite(t).all():
        raise DataError(f"{label}: t holds NaN or infinity")
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back):
        i = int(back[0])
        raise DataError(
            f"{label}: time does not increase after sample {i}: {t[i]:.9g} s, then {t[i + 1]:.9g} s"
        )
