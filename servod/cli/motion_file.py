"""Reads the reference motion of `servoctl track csv`: checks it and puts it on the loop's time grid."""

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.common.yaml import read_text
from servod.runtime.loop.channel import TRAJECTORY_SAMPLES

COLUMNS = ("t_s", "reference_rad")
#: Spreadsheets begin UTF-8 files with it.
_BYTE_ORDER_MARK = "\ufeff"


class MotionFile(NamedTuple):
    """The samples of a file, times in s that grow and positions in rad."""

    path: Path
    times: list[float]
    positions: list[float]

    def on_grid(self, period_s: float) -> list[float]:
        """Positions in rad, one for each period, linear between the samples.

        Raises BadInput when the motion is shorter than a period or longer than the loop's memory.
        """
        length_s, longest_s = self.times[-1] - self.times[0], (TRAJECTORY_SAMPLES - 1) * period_s
        if not period_s <= length_s * (1.0 + 1e-9):
            raise BadInput(f"{self.path}: t_s", f"{length_s:g} s in all", f"at least one period of {period_s:g} s")
        if not length_s <= longest_s * (1.0 + 1e-9):
            raise BadInput(f"{self.path}: t_s", f"{length_s:g} s in all", _longest(longest_s, period_s))
        count = math.floor(length_s / period_s + 1e-6) + 1
        return [_at(self.times, self.positions, self.times[0] + k * period_s) for k in range(count)]


def _longest(longest_s: float, period_s: float) -> str:
    return f"at most {longest_s:g} s, which is {TRAJECTORY_SAMPLES} samples at one for each {period_s:g} s"


def read_motion(path: Path) -> MotionFile:
    """The motion in `path`; raises BadInput (file, column, row)."""
    times, positions = _columns(path)
    if len(times) < 2:
        raise BadInput(f"{path}: t_s", f"{len(times)} rows", "at least 2 rows")
    return MotionFile(path, times, positions)


def _columns(path: Path) -> tuple[list[float], list[float]]:
    text = read_text(path).removeprefix(_BYTE_ORDER_MARK)
    reader = csv.DictReader(line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    if any(";" in name for name in reader.fieldnames or ()):
        raise BadInput(f"{path}: separator", "`;`", "`,` between columns, and a point in numbers")
    missing = [c for c in COLUMNS if c not in (reader.fieldnames or ())]
    if missing:
        found = ", ".join(map(str, reader.fieldnames or ())) or "an empty file"
        raise BadInput(f"{path}: {missing[0]}", found, "a CSV file with the columns t_s and reference_rad")
    rows = [[_number(path, name, row_number, row[name]) for name in COLUMNS] for row_number, row in _rows(reader)]
    times = [row[0] for row in rows]
    for row_number, (earlier, later) in enumerate(pairwise(times), start=3):
        if later <= earlier:
            raise BadInput(f"{path}: t_s, row {row_number}", f"{later} after {earlier}", "times that grow")
    return times, [row[1] for row in rows]


def _rows(reader: csv.DictReader[str]) -> Iterable[tuple[int, dict[str, str | None]]]:
    """Rows with their number in the file; the header is row 1."""
    return enumerate(reader, start=2)


def _number(path: Path, column: str, row: int, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BadInput(f"{path}: {column}, row {row}", repr(text), "a finite number")
    return value


def _at(times: list[float], positions: list[float], t_s: float) -> float:
    after = min(max(bisect_right(times, t_s), 1), len(times) - 1)
    t0, t1, x0, x1 = times[after - 1], times[after], positions[after - 1], positions[after]
    return x0 + (x1 - x0) * min(max((t_s - t0) / (t1 - t0), 0.0), 1.0)
