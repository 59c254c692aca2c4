"""One experiment's recording as arrays, and the list of all of them: what every fit takes.

Between the links (which move the axis), the recordings on disk, and the fits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from servod.lab.recordings.rows import ROW

Array = NDArray[np.float64]


class Kind(StrEnum):
    """What a recording was made for; each has its file in `experiments`."""

    NOISE = "noise"
    BREAK_AWAY = "break_away"
    PRESLIDING = "presliding"
    KICK = "kick"
    RESPONSE = "response"
    BRISTLE = "bristle"
    FRICTION_MAP = "friction_map"


@dataclass(frozen=True)
class Trace:
    """One motion, a value for each cycle in SI units; `settings` are what the fit must know of the experiment.

    `motor_rad` is the joint's position by the amplifier's own sensor; `sha256` is the hash of the recording's file.
    """

    kind: Kind
    t_s: Array
    torque_nm: Array
    position_rad: Array
    reference_rad: Array
    excitation_nm: Array
    torque_actual_nm: Array
    motor_rad: Array
    settings: dict[str, float] = field(default_factory=dict)
    sha256: str = ""

    @property
    def period_s(self) -> float:
        """Median time between two cycles."""
        return float(np.median(np.diff(self.t_s)))

    def __len__(self) -> int:
        return len(self.t_s)


def trace_of(kind: Kind, rows: NDArray[np.void], settings: dict[str, float]) -> Trace:
    """The trace in cycle records (dtype servod.lab.recordings.rows.ROW)."""
    time_ns = rows["time_ns"]
    return Trace(
        kind,
        (time_ns - time_ns[0]) * 1e-9,
        rows["torque_nm"].copy(),
        rows["position_rad"].copy(),
        rows["reference_rad"].copy(),
        rows["torque_other_nm"].copy(),
        rows["torque_actual_nm"].copy(),
        rows["motor_position_rad"].copy(),
        settings,
    )


def rows_of(raw: bytes | bytearray) -> NDArray[np.void]:
    """Packed cycle records as structured rows."""
    return np.frombuffer(bytes(raw), dtype=ROW)
