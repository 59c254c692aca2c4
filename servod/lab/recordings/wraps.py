"""Positions that wrap: an encoder or a protocol starts anew at the end of its range; and positions in another unit.

Between the columns and the recording. A wrap is undone where the rows say so beyond doubt: all jumps are of one size,
go from one end of the range to the other, and the motion goes on behind them as it was.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Ranges that encoders and protocols have: a turn, ±12.5 rad of small drives' 16-bit positions, degrees, counts.
NAMED = (2.0 * math.pi, 25.0, 360.0, 4096.0, 8192.0, 16384.0, 65536.0)
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
    named = next((one for one in NAMED if abs(size - one) < _SAME_SHARE * one), None)
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
