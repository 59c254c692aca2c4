"""A recording in canonical columns, with a report of what was uneven or missing and how it was handled.

Stands between the readers and everything that works on recordings: replay, identification, diagnosis.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.common.units import counted
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.formats.model.drive import DriveKind, DriveLaw
from servod.formats.recording.record import FIELDS
from servod.lab.recordings.columns import (
    COMMANDS,
    REQUIRED,
    ColumnSource,
    Element,
    Quantity,
    apply_map,
    axis_of,
    load_column_map,
    wanted_names,
)
from servod.lab.recordings.numbers import element, numbers
from servod.lab.recordings.readers import read_columns
from servod.lab.simulate.replay import Drive
from servod.lab.simulate.servo import ToldRows

Array = NDArray[np.float64]

#: Fewest rows that make a recording.
LEAST_ROWS = 10

#: Share of missing cells in a required column from which filling would be invention.
MOST_MISSING = 0.5

#: No measurement is so large; such a cell counts as missing, as one that is not finite does.
LARGEST = 1e30

#: Time between rows, s, beyond which the column is surely in another unit.
SHORTEST_STEP_S, LONGEST_STEP_S = 1e-6, 20.0

#: What a drive of each kind is told.
_COMMANDS = {
    DriveKind.POSITION_SERVO: Quantity.REFERENCE,
    DriveKind.VELOCITY: Quantity.SPEED_REFERENCE,
    DriveKind.VOLTAGE: Quantity.VOLTAGE,
    DriveKind.CURRENT: Quantity.CURRENT,
}

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
        """Commanded torque (force), held over each sample. Raises BadInput where the recording has none."""
        if Quantity.TORQUE not in self.columns:
            name = Quantity.TORQUE.column(self.axis)
            there = ", ".join(quantity.column(self.axis) for quantity in COMMANDS if quantity in self.columns)
            allowed = f"{name}; a --map file makes it of a current, a voltage or a duty, a drive: in the model of any"
            raise BadInput(f"{self.path}: column {name}", f"none (there is {there})", allowed)
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
            begin, end = (
                "its start" if from_s is None else f"{from_s:g} s",
                "its end" if to_s is None else f"{to_s:g} s",
            )
            found = f"{counted(max(last - first, 0), 'row')} from {begin} to {end}"
            raise BadInput(f"{self.path}: column t_s", found, f"{self.t_s[0]:g} to {self.t_s[-1]:g} s")
        if last - first == len(self):
            return self
        columns = {quantity: values[first:last] for quantity, values in self.columns.items()}
        note = f"rows from {self.t_s[first]:g} to {self.t_s[last - 1]:g} s used, as asked"
        return replace(self, columns=columns, measured=self.measured[first:last], report=(*self.report, note))

    @cached_property
    def drive(self) -> Drive:
        """What a replay needs of the recording."""
        return Drive(self.t_s, self.torque, self.position, self._row(Quantity.TEMPERATURE))

    def driven_by(self, model: AxisModel) -> Drive:
        """What a replay of `model` needs: what its drive was told where the model has one, else as `drive`.

        The torque is not made of it yet (`servod.lab.simulate.replay.driven`).
        Raises BadInput where the recording lacks what that drive is told, or its gain is known to neither.
        """
        if model.drive is None:
            return self.drive
        if model.drive.factor is None:
            allowed = "N*m of a full duty, a V or an A: give it, or k_t; diagnose fits it"
            raise BadInput("model: drive.torque_per_command", "none", allowed)
        temperature, command = self._row(Quantity.TEMPERATURE), self._command(model.drive)
        command_rows = ToldRows(
            command, self._row(Quantity.GAIN), self._row(Quantity.SUPPLY), self._on(model.drive, command)
        )
        if model.drive.kind.feeds_back and model.drive.kp is None and not np.isfinite(command_rows.gain).all():
            raise BadInput(f"{self.path}: column kp", "none", "kp, or drive.kp in the model: the gain of its servo")
        if model.drive.by_supply and model.drive.supply_v is None and not np.isfinite(command_rows.supply_v).all():
            raise BadInput(f"{self.path}: column supply_v", "none", "supply_v, or drive.supply_v in the model")
        return Drive(self.t_s, np.zeros(len(self)), self.position, temperature, command_rows)

    def _row(self, quantity: Quantity) -> Array:
        """An optional column with its holes filled; NaN where there is none."""
        values = self.get(quantity)
        return np.full(len(self), np.nan) if values is None else _filled(self.t_s, values)

    def _on(self, law: DriveLaw, command: Array) -> NDArray[np.bool_]:
        """Rows in which the drive is on: by `enabled`, or by the duty that a servo reports beside its goal."""
        enabled, duty = self.get(Quantity.ENABLED), self.get(Quantity.DUTY)
        if enabled is not None:
            kept = _held(enabled) if np.isfinite(enabled).any() else np.ones(len(self))
            return kept > 0.5
        if duty is None or law.kind is not DriveKind.POSITION_SERVO:
            return np.ones(len(self), dtype=bool)
        return on_by_duty(duty, command - self.position)

    def _command(self, law: DriveLaw) -> Array:
        """The column that a drive of this law is told, holes held. Raises BadInput where the recording has none."""
        wanted = _COMMANDS[law.kind]
        values = self.get(wanted)
        if values is None and law.kind is DriveKind.VOLTAGE and (duty := self.get(Quantity.DUTY)) is not None:
            supply = self._row(Quantity.SUPPLY)
            known = np.where(np.isfinite(supply), supply, np.nan if law.supply_v is None else law.supply_v)
            values = duty * known
        if values is None or not np.isfinite(values).any():
            name, there = wanted.column(self.axis), ", ".join(q.column(self.axis) for q in self.columns)
            allowed = f"{name}, as drive.kind {law.kind.value} of the model is told"
            raise BadInput(f"{self.path}: column {name}", f"none (there is {there})", allowed)
        return _held(values)


#: Where a drive reports no duty at all, it is off if its error elsewhere makes such a duty: a dead band is smaller.
OFF_ASKED = 0.2


def on_by_duty(duty: Array, error: Array) -> NDArray[np.bool_]:
    """Rows in which a servo is on, by the duty that it reports and its error.

    It is off for as long as the duty is exactly nothing, where the error comes to what elsewhere makes OFF_ASKED of a
    full duty: a servo at its goal, and one within its dead band, make none either, and are on.
    """
    on = np.ones(len(duty), dtype=bool)
    made = np.isfinite(duty) & (duty != 0.0) & (np.abs(duty) < 0.99 * np.nanmax(np.abs(duty), initial=0.0))
    if not made.any():
        return on
    asked = np.abs(error) * float(np.median(np.abs(duty[made]) / np.maximum(np.abs(error[made]), 1e-12)))
    edges = np.flatnonzero(np.diff((duty == 0.0).astype(np.int8), prepend=0, append=0))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        on[first:end] = float(np.max(asked[first:end])) < OFF_ASKED
    return on


def _held(values: Array) -> Array:
    """A column with its holes filled by the value before, and those ahead of the first by that."""
    holes = ~np.isfinite(values)
    kept = np.maximum.accumulate(np.where(holes, -1, np.arange(len(values))))
    return np.asarray(values[np.where(kept < 0, int(np.argmin(holes)), kept)])


def load_recording(path: str | Path, map_path: str | Path | None = None) -> Recording:
    """Read, name, check and repair the recording at `path`; `map_path` is a `--map` file, or the name of a shipped one.

    A recording without a torque is read as well where it has a goal position, a voltage, a duty or a current.
    Raises BadInput naming file and column.
    """
    path = Path(path)
    sources = load_column_map(Path(map_path)) if map_path is not None else {}
    foreign, report = read_columns(path, wanted_names(sources.values()))
    chosen, elements, unused = apply_map(foreign, sources, str(path))
    axis = axis_of(chosen, foreign, str(path))
    columns: dict[Quantity, Array] = {}
    for quantity in Quantity:
        source = chosen.get(name := quantity.column(axis))
        if source is not None:
            columns[quantity] = _scaled(_column(foreign, elements.get(name), source, path), name, source)
    foreign.clear()  # a large file's columns would stand in memory twice
    for quantity, values in columns.items():
        if not values.ndim and quantity is not Quantity.TIME:
            columns[quantity] = np.full(columns[Quantity.TIME].size, float(values))
    if unused:
        report.append(f"columns not used: {', '.join(unused)}")
    return _checked(path, axis, columns, report)


def _column(foreign: dict[str, Any], cell: Element | None, source: ColumnSource, path: Path) -> Array:
    """The numbers of one source, one for each row; without dimensions where one number holds for all."""
    if cell is None:
        behind = re.search(rf"{re.escape(source.from_name or '')}([-+]?\d+(?:\.\d+)?)", path.name)
        if behind is None:
            raise BadInput(f"{path}: file's name", "no number", f"a number behind {source.from_name!r}, as mapped")
        return np.array(float(behind[1]))
    column = foreign[cell.name]
    if cell.at is not None:
        column = element(column, cell.at, cell.row, path, cell.name)
    values = numbers(column, path, cell.name)
    if values.ndim > 1:
        rows, count = values.shape
        found, allowed = f"a matrix of {rows} rows and {count} columns", f"from: {cell.name}[:,0] to [:,{count - 1}]"
        raise BadInput(f"{path}: column {cell.name}", found, allowed)
    return values


def _scaled(values: Array, name: str, source: ColumnSource) -> Array:
    """In the canonical unit; what no measurement can be is missing."""
    scale, offset = source.line(name)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = np.asarray(scale * values + offset)
        scaled[~(np.abs(scaled) < LARGEST)] = np.nan
    return scaled


def _checked(path: Path, axis: AxisKind, columns: dict[Quantity, Array], report: list[str]) -> Recording:
    """Equal lengths, enough rows, time forward; holes filled and reported."""
    rows = columns[Quantity.TIME].size
    if rows < LEAST_ROWS:
        raise BadInput(f"{path}: column t_s", f"{rows} rows", f"at least {LEAST_ROWS}")
    for quantity, values in columns.items():
        name = quantity.column(axis)
        if len(values) != rows:
            raise BadInput(f"{path}: column {name}", f"{len(values)} rows", f"{rows} rows, as t_s has")
        missing = np.count_nonzero(~np.isfinite(values))
        if quantity in (*REQUIRED, Quantity.TORQUE) and missing > MOST_MISSING * rows:
            raise BadInput(
                f"{path}: column {name}", f"{missing} of {rows} cells without a number", "at most half missing"
            )
    measured = np.isfinite(columns[Quantity.POSITION])
    _fill_holes(columns, axis, report)
    _check_time(path, columns, report)
    _unwrap(columns, axis, report)
    return Recording(path, axis, columns, measured, tuple(report))


def _unwrap(columns: dict[Quantity, Array], axis: AxisKind, report: list[str]) -> None:
    """Join a position that wraps, with its reference, and ask where it looks like another unit."""
    position = columns[Quantity.POSITION]
    size, name = find_wrap(position), Quantity.POSITION.column(axis)
    if (doubt := doubtful_unit(position, size, axis is AxisKind.ROTARY)) is not None:
        report.append(f"{name}: {doubt}")
    if size is None:
        return
    joined = unwrapped(position, size)
    jumps = int(np.count_nonzero(np.abs(np.diff(position)) > 0.5 * size))
    columns[Quantity.POSITION] = joined
    if (reference := columns.get(Quantity.REFERENCE)) is not None:
        columns[Quantity.REFERENCE] = beside(reference, position, joined, size)
    report.append(f"{name}: {jumps} jumps of {size:.6g}, joined: the position wraps there")


def _fill_holes(columns: dict[Quantity, Array], axis: AxisKind, report: list[str]) -> None:
    """Fill missing cells of the required columns: time and position linearly, torque by its last value."""
    for quantity in (Quantity.TIME, Quantity.TORQUE, Quantity.POSITION):
        values = columns.get(quantity)
        if values is None or not (holes := ~np.isfinite(values)).any():
            continue
        row = np.arange(len(values), dtype=np.float64)
        if quantity is Quantity.TORQUE:
            columns[quantity] = _held(values)
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


#: No gap is told to be of more samples than this.
_MOST_MISSING = 1e9


def missing_samples(t_s: Array, cycle: Array | None = None) -> NDArray[np.int64]:
    """How many samples are missing before each row but the first, shape (n - 1,).

    By the numbers of the cycles where they count rows: a stamp says when its cycle began, and one that began late
    leaves a gap in time behind which nothing is missing. Else by the stamps, of which one that is late makes the next
    step as much shorter.
    """
    if len(t_s) < 2:
        return np.zeros(0, dtype=np.int64)
    if cycle is not None:
        counted = np.diff(cycle)
        if np.all(counted >= 1.0) and np.median(counted) == 1.0:
            return counted.astype(np.int64) - 1
    with np.errstate(over="ignore", invalid="ignore"):  # stamps of a bent file may be any number
        steps = np.diff(t_s)
        period = float(np.median(steps))
        if not period > 0.0:
            return np.zeros(len(steps), dtype=np.int64)
        late = np.append(np.maximum(period - steps[1:], 0.0), 0.0)
        missing = np.nan_to_num(np.round((steps - late) / period) - 1.0, nan=0.0)
        return np.where(steps > 1.5 * period, np.clip(missing, 0.0, _MOST_MISSING), 0.0).astype(np.int64)


def _check_time(path: Path, columns: dict[Quantity, Array], report: list[str]) -> None:
    """Time must not run backwards; doubled stamps, uneven steps and gaps are reported."""
    t_s = columns[Quantity.TIME]
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
    missing = missing_samples(t_s, columns.get(Quantity.CYCLE))
    if missing.any():
        worst = int(np.argmax(np.where(missing > 0, steps, 0.0)))
        report.append(
            f"t_s: {np.count_nonzero(missing)} gaps, about {missing.sum()} samples missing, the longest "
            f"{steps[worst]:.4g} s at {t_s[worst]:.6g} s; simulated on the recorded stamps"
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


# --- Positions that wrap ---------------------------------------------------------------------------------------------
# Positions that wrap: an encoder or a protocol starts again at the end of its range; and positions in another unit.
#
# A wrap is undone where the rows say so beyond doubt: all jumps are of one size, go from one end of the range to the
# other, and the motion goes on behind them as it was.


#: Ranges that encoders and protocols have: a turn, ±12.5 rad of small drives' 16-bit positions, degrees, counts.
RANGES = (2.0 * math.pi, 25.0, 360.0, 4096.0, 8192.0, 16384.0, 65536.0)
#: Share of the range within which a jump begins and ends, and by which jumps may differ; of a named range, of its size.
_END_SHARE, _SAME_SHARE = 0.1, 0.02
#: Rows for each jump at least: between two of them the motion must be seen.
_ROWS_EACH, _APART_ROWS = 6, 3
#: A position that spans so many whole numbers is no angle in rad and no way in m.
_LEAST_COUNTS = 1000.0


def find_wrap(position: Array) -> float | None:
    """The range within which a position wraps, in its unit; None where it does not, or not beyond doubt.

    >>> find_wrap((np.linspace(0.0, 90.0, 1000) + 12.5) % 25.0 - 12.5)
    25.0
    """
    if len(position) < _ROWS_EACH or not np.isfinite(position).all():
        return None
    low, high = float(position.min()), float(position.max())
    steps = np.diff(position)
    rows = np.flatnonzero(np.abs(steps) > 0.5 * (high - low))
    if not len(rows) or len(rows) * _ROWS_EACH > len(steps) or rows[0] == 0 or rows[-1] == len(steps) - 1:
        return None
    if np.any(np.diff(rows) < _APART_ROWS):
        return None  # a glitch leaves and comes back
    around = 0.5 * (steps[rows - 1] + steps[rows + 1])  # what the motion does without the jump
    sizes = np.abs(steps[rows] - around)
    size = float(np.median(sizes))
    named = next((one for one in RANGES if abs(size - one) < _SAME_SHARE * one), None)
    usual = np.delete(np.abs(steps), rows)
    slack = max(_SAME_SHARE * size, float(usual.max()))
    ends = np.minimum(np.abs(position - low), np.abs(position - high)) < _END_SHARE * size + slack
    onward = np.sign(around) == -np.sign(steps[rows])  # it went towards the end at which it jumps
    sure = (
        np.all(np.abs(sizes - size) <= slack)
        and bool(np.all(ends[rows] & ends[rows + 1]))
        and high - low <= size + slack
        and float(np.mean(onward)) > 0.8
        and float(usual.max()) < 0.25 * size
        and (named is not None or len(rows) > 1)
    )
    return (size if named is None else named) if sure else None


def unwrapped(position: Array, size: float) -> Array:
    """The position without jumps of this size."""
    steps = np.diff(position)
    turns = np.where(np.abs(steps) > 0.5 * size, -np.round(steps / size), 0.0)
    return position + size * np.concatenate([[0.0], np.cumsum(turns)])


def beside(reference: Array, wrapped: Array, position: Array, size: float) -> Array:
    """A reference that wraps with its position (`wrapped`), put beside the unwrapped one where it jumps as well."""
    if not np.any(np.abs(np.abs(np.diff(reference)) - size) < 0.5 * size):
        return reference + (position - wrapped)
    return reference + size * np.round((position - reference) / size)


def doubtful_unit(position: Array, wrap: float | None, rotary: bool) -> str | None:
    """A question where a position looks like another unit than rad or m; it is never changed."""
    known = position[np.isfinite(position)]
    span = float(np.ptp(known)) if len(known) else 0.0
    if span >= _LEAST_COUNTS and np.array_equal(known, np.round(known)):
        return f"position spans {span:.6g}, in whole numbers: counts? (unit: counts in a --map file)"
    if not rotary or not len(known):
        return None
    back = float(np.max(np.maximum.accumulate(known) - known))
    forth = float(np.max(known - np.minimum.accumulate(known)))
    both_ways = min(back, forth) > 0.25 * span  # a motor may turn on and on
    if wrap == 360.0 or (span > 8.0 * math.pi and float(np.abs(known).max()) <= 360.0 and both_ways and wrap is None):
        return f"position spans {span:.4g} rad: degrees? (unit: deg in a --map file)"
    return None
