"""Units and scalings, in one place: everything above the drivers speaks SI, everything on the wire speaks counts.

Stands on nothing. Used by drivers (wire <-> SI), reports and tests.
"""

from __future__ import annotations

import math

NS_PER_S = 1_000_000_000
NS_PER_US = 1_000
TWO_PI = 2.0 * math.pi

#: CiA 402 expresses 0x6071, 0x6072, 0x6074 and 0x6077 in thousandths of 0x6076 (rated torque).
PER_MILLE = 1000.0


def rad_per_count(counts_per_turn: float) -> float:
    """Angle of one encoder count, in rad; `counts_per_turn` is e.g. 0x6001 of CiA 406."""
    return TWO_PI / counts_per_turn


def counted(count: int, noun: str) -> str:
    """A count with its noun: "1 recording", "2 recordings"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def wrapped_difference(new_counts: int, old_counts: int, measuring_range: int) -> int:
    """Shortest signed way from `old_counts` to `new_counts` on a counter that wraps at `measuring_range`.

    Works for any range, also one that is not a power of two (CiA 406, 0x6002).
    """
    difference = (new_counts - old_counts) % measuring_range
    if 2 * difference > measuring_range:
        difference -= measuring_range
    return difference
