"""Reads the reference motion of `servoctl track csv`: checks it and puts it on the loop's time grid."""

from __future__ import annotations

import csv
import math
from bisect import bisect_right
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

from servod.errors import BadInput
from servod.yaml12 import read_text

COLUMNS = ("t_s", "reference_rad")


def read_motion(path: Path, period_s: float) -> list[float]:
    """Positions in rad, one for each period, linear between the file's samples; raises BadInput (file, column, row)."""
    times, positions = _columns(path)
    if len(times) < 2:
        raise BadInput(f"{path}: t_s", f"{len(times)} rows", "at least 2 rows")
    count = math.floor((times[-1] - times[0]) / period_s + 1e-9) + 1
    if count < 2:
        raise BadInput(f"{path}: t_s", f"{times[-1] - times[0]} s in all", f"more than one period of {period_s} s")
    return [_at(times, positions, times[0] + k * period_s) for k in range(count)]


def _columns(path: Path) -> tuple[list[float], list[float]]:
    lines = (line for line in read_text(path).splitlines() if line.strip() and not line.startswith("#"))
    reader = csv.DictReader(lines)
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
