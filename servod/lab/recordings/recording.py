"""A recording in canonical columns, with a report of what was uneven or missing and how it was handled.

Stands between the readers and everything that works on recordings: replay, identification, diagnosis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisKind
from servod.formats.recording.record import FIELDS
from servod.lab.recordings.columns import ALL_NAMES, REQUIRED, Quantity, apply_map, axis_of, load_column_map
from servod.lab.recordings.readers import numbers, read_columns
from servod.lab.simulate.replay import Drive

Array = NDArray[np.float64]

#: Fewest rows that make a recording.
LEAST_ROWS = 10

#: Share of missing cells in a required column from which filling would be invention.
MOST_MISSING = 0.5

#: No measurement is so large; such a cell counts as missing, as one that is not finite does.
LARGEST = 1e30

#: Time between rows, s, beyond which the column is surely in another unit.
SHORTEST_STEP_S, LONGEST_STEP_S = 1e-6, 20.0

#: Steps that differ from the median by more than this share make a recording uneven.
UNEVEN_SHARE = 0.1


@dataclass(frozen=True)
class Recording:
    """One recording: rows of equal length for each quantity that it has, SI units of the axis (rad or m, N*m or N).

    Required quantities are finite; `measured` is False in rows whose position was filled. `report` says in plain
    sentences what was uneven or missing and what was done about it.
    """

    path: Path
    axis: AxisKind
    columns: dict[Quantity, Array]
    measured: NDArray[np.bool_]
    report: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.t_s)

    @property
    def t_s(self) -> Array:
        """The recording's own time stamps, s."""
        return self.columns[Quantity.TIME]

    @property
    def torque(self) -> Array:
        """Commanded torque (force), held over each sample."""
        return self.columns[Quantity.TORQUE]

    @property
    def position(self) -> Array:
        """Recorded motor position."""
        return self.columns[Quantity.POSITION]

    def get(self, quantity: Quantity) -> Array | None:
        """A column, or None when the recording does not have it; optional columns may hold NaN."""
        return self.columns.get(quantity)

    def between(self, from_s: float | None, to_s: float | None) -> Recording:
        """The rows from `from_s` to before `to_s`, in the recording's own time (None: its start, its end).

        Raises BadInput where fewer than LEAST_ROWS are left.
        """
        first = 0 if from_s is None else int(np.searchsorted(self.t_s, from_s))
        last = len(self) if to_s is None else int(np.searchsorted(self.t_s, to_s))
        if last - first < LEAST_ROWS:
            found = f"{max(last - first, 0)} rows from {from_s} to {to_s} s"
            raise BadInput(f"{self.path}: column t_s", found, f"{self.t_s[0]:g} to {self.t_s[-1]:g} s")
        if last - first == len(self):
            return self
        columns = {quantity: values[first:last] for quantity, values in self.columns.items()}
        told = f"rows from {self.t_s[first]:g} to {self.t_s[last - 1]:g} s used, as asked"
        return replace(self, columns=columns, measured=self.measured[first:last], report=(*self.report, told))

    @cached_property
    def drive(self) -> Drive:
        """What a replay needs of the recording."""
        warm = self.get(Quantity.TEMPERATURE)
        temperature = np.full(len(self), np.nan) if warm is None else _filled(self.t_s, warm)
        return Drive(self.t_s, self.torque, self.position, temperature)


def load_recording(path: str | Path, map_path: str | Path | None = None) -> Recording:
    """Read, name, check and repair the recording at `path`; `map_path` is a `--map` file.

    Raises BadInput naming file and column.
    """
    path = Path(path)
    sources = load_column_map(Path(map_path)) if map_path is not None else {}
    foreign, report = read_columns(path, {*ALL_NAMES, *(source.source for source in sources.values())})
    chosen, unused = apply_map(foreign, sources, str(path))
    axis = axis_of(chosen, foreign, str(path))
    columns = {}
    for quantity in Quantity:
        source = chosen.get(quantity.column(axis))
        if source is not None:
            values = numbers(foreign[source.source], path, source.source)
            with np.errstate(over="ignore", invalid="ignore"):
                scaled = source.scale * values + source.offset
                scaled[~(np.abs(scaled) < LARGEST)] = np.nan
            columns[quantity] = scaled
    foreign.clear()  # a large file's columns would stand in memory twice
    if unused:
        report.append(f"columns not used: {', '.join(unused)}")
    return _checked(path, axis, columns, report)


def _checked(path: Path, axis: AxisKind, columns: dict[Quantity, Array], report: list[str]) -> Recording:
    """Equal lengths, enough rows, time forward; holes filled and reported."""
    rows = len(columns[Quantity.TIME])
    if rows < LEAST_ROWS:
        raise BadInput(f"{path}: column t_s", f"{rows} rows", f"at least {LEAST_ROWS}")
    for quantity, values in columns.items():
        name = quantity.column(axis)
        if len(values) != rows:
            raise BadInput(f"{path}: column {name}", f"{len(values)} rows", f"{rows} rows, as t_s has")
        missing = np.count_nonzero(~np.isfinite(values))
        if quantity in REQUIRED and missing > MOST_MISSING * rows:
            raise BadInput(
                f"{path}: column {name}", f"{missing} of {rows} cells without a number", "at most half missing"
            )
    measured = np.isfinite(columns[Quantity.POSITION])
    _fill_holes(columns, axis, report)
    _check_time(path, columns[Quantity.TIME], report)
    return Recording(path, axis, columns, measured, tuple(report))


def _fill_holes(columns: dict[Quantity, Array], axis: AxisKind, report: list[str]) -> None:
    """Fill missing cells of the required columns: time and position linearly, torque by its last value."""
    for quantity in REQUIRED:
        values = columns[quantity]
        holes = ~np.isfinite(values)
        if not holes.any():
            continue
        row = np.arange(len(values), dtype=np.float64)
        if quantity is Quantity.TORQUE:
            kept = np.maximum.accumulate(np.where(holes, -1, np.arange(len(values))))
            columns[quantity] = values[np.where(kept < 0, int(np.argmin(holes)), kept)]
        else:
            along = row if quantity is Quantity.TIME else columns[Quantity.TIME]
            columns[quantity] = np.interp(along, along[~holes], values[~holes])
        how = "its last value held" if quantity is Quantity.TORQUE else "filled linearly"
        first = int(np.argmax(holes)) + 1
        report.append(f"{quantity.column(axis)}: {np.count_nonzero(holes)} missing cells (first in row {first}), {how}")


def _filled(t_s: Array, values: Array) -> Array:
    """An optional column with its holes filled linearly; all NaN when it has no number at all."""
    known = np.isfinite(values)
    return np.interp(t_s, t_s[known], values[known]) if known.any() else values


def _check_time(path: Path, t_s: Array, report: list[str]) -> None:
    """Time must not run backwards; doubled stamps, uneven steps and gaps are reported."""
    steps = np.diff(t_s)
    back = np.flatnonzero(steps < 0.0)
    if len(back):
        row = int(back[0]) + 2
        raise BadInput(
            f"{path}: column t_s, row {row}", f"{t_s[row - 1]:g} after {t_s[row - 2]:g}", "time that runs forward"
        )
    period = float(np.median(steps))
    if period <= 0.0:
        raise BadInput(f"{path}: column t_s", "the same time in most rows", "time that runs forward, in seconds")
    if not SHORTEST_STEP_S <= period <= LONGEST_STEP_S:
        allowed = f"{SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} s, with t_s in seconds; a --map file scales it"
        raise BadInput(f"{path}: column t_s", f"{period:.3g} s between rows", allowed)
    doubled = int(np.count_nonzero(steps == 0.0))
    if doubled:
        report.append(f"t_s: {doubled} time stamps twice; such rows get the same simulated value")
    uneven = np.abs(steps - period) > UNEVEN_SHARE * period
    gaps = steps > 1.5 * period
    if gaps.any():
        lost = int(np.sum(np.round(steps[gaps] / period) - 1.0))
        worst = int(np.argmax(steps))
        report.append(
            f"t_s: {int(gaps.sum())} gaps, about {lost} samples missing, the longest {steps[worst]:.4g} s at "
            f"{t_s[worst]:.6g} s; simulated on the recorded stamps"
        )
    if uneven.mean() > 0.01:
        share = 100.0 * float(uneven.mean())
        report.append(
            f"t_s: uneven, steps from {steps.min():.4g} to {steps.max():.4g} s around {period:.4g} s "
            f"({share:.0f} % differ by over 10 %); simulated on the recorded stamps"
        )


# --- Cycle records as rows -------------------------------------------------------------------------------------------
# Cycle records as rows of a numpy structured array: the same bytes as `servod.formats.recording.record.RECORD`.


#: One cycle record as a row of a structured array.
ROW = np.dtype([(f.name, "<f8" if f.kind == "d" else "<i8") for f in FIELDS])
Rows = NDArray[np.void]


def rows_of(raw: bytes | bytearray) -> Rows:
    """Packed cycle records as structured rows, which look into `raw` and copy nothing."""
    return np.frombuffer(raw, dtype=ROW)


def moving(rows: Rows) -> Rows:
    """The cycles in which a reference motion ran."""
    active: Rows = rows[rows["reference_active"] == 1]
    return active
