"""Ranges of searches: a number that stands at the end of its range was not found there, and says so.

Under the fits that search; the linear ones have no ranges.
"""

from __future__ import annotations

from collections.abc import Sequence

#: The note of such a number.
AT_END = "at the end of its range"
#: Closer to a bound than this share of its range is on it.
ON_BOUND = 1e-3


def at_ends(values: Sequence[float], low: Sequence[float], high: Sequence[float]) -> tuple[str, ...]:
    """A note for each of `values` that a search between `low` and `high` left at an end, empty for the others."""
    places = [(v - a) / (b - a) for v, a, b in zip(values, low, high, strict=True)]
    return tuple(AT_END if place < ON_BOUND or place > 1.0 - ON_BOUND else "" for place in places)


def joined(*notes: str) -> str:
    """Notes of one number as one."""
    return "; ".join(note for note in notes if note)
