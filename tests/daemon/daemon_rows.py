"""Packed cycle records for tests of everything around the loop."""

from __future__ import annotations

from servod.record import FIELDS, RECORD, CycleRecord

_ZERO = CycleRecord._make(0 if f.kind == "q" else 0.0 for f in FIELDS)


def record(cycle: int = 0, **values: float) -> CycleRecord:
    """One cycle, 1 ms after the other, with the named values set."""
    return _ZERO._replace(
        **{"time_ns": cycle * 1_000_000, "cycle": cycle, "lag_ns": 50_000, "tick_ns": 40_000, **values}
    )


def row(cycle: int = 0, **values: float) -> bytes:
    """The same, packed."""
    return RECORD.pack(*record(cycle, **values))


def rows(count: int, first: int = 0) -> list[bytes]:
    """`count` packed cycles with a position that names the cycle."""
    return [row(c, position_rad=c * 0.001) for c in range(first, first + count)]
