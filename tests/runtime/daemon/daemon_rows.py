"""Packed cycle records and a configuration for tests of everything around the loop."""

from __future__ import annotations

from pathlib import Path

from servod.formats.config import AxisConfig
from servod.formats.recording.record import FIELDS, RECORD, CycleRecord

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


def axis_config(socket: Path, channel: Path) -> AxisConfig:
    """An axis with these paths."""
    limits = {
        "torque_nm": 1,
        "torque_rate_nm_per_s": 1,
        "speed_rad_s": 1,
        "position_min_rad": -1,
        "position_max_rad": 1,
        "following_error_rad": 1,
        "encoder_mismatch_rad": 1,
    }
    return AxisConfig.model_validate(
        {
            "limits": limits,
            "gains": {"initial": "x.yaml"},
            "control": {"socket": str(socket)},
            "bus": {"channel": str(channel)},
        }
    )
