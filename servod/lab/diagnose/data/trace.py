"""One recording as the diagnosis works on it: rows, what is known of their noise, and which rows count.

Stands between `intake`, which makes and checks it, and `predict`, which compares it with a model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.lab.simulate.motion import Beginning, FirstRow, Start, beginning, noise_rms
from servod.lab.simulate.replay import Drive, behind_gaps

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]


@dataclass(frozen=True)
class CheckedTrace:
    """A checked recording: `drive` (SI units of the axis), `counts` marks the rows that may be compared with a model.

    `notes` say in plain sentences what was found wrong and what was done about it. `shift_s` was added to the recorded
    times, so that no instant stands in two recordings and an event can belong to one of them;
    `begun_s` is the time of its first row then, also for a part of it.
    """

    name: str
    drive: Drive
    counts: Rows
    notes: tuple[str, ...]
    has_temperature: bool = False
    shift_s: float = 0.0
    begun_s: float = 0.0

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Rows where the motion begins again: the first, and those behind long gaps."""
        return np.unique(np.concatenate([[0], behind_gaps(self.drive.t_s)])).astype(np.int64)

    @cached_property
    def at_its_own_times(self) -> Drive:
        """The rows at the recording's own times, not shifted to those of the others."""
        drive = self.drive
        return Drive(drive.t_s - self.shift_s, drive.torque, drive.position, drive.temperature_c, drive.told)

    @cached_property
    def position_noise(self) -> float:
        """RMS of the position's noise, quantisation included, rad or m."""
        return noise_rms(self.drive.position)

    @cached_property
    def velocity(self) -> Array:
        """Smoothed velocity of each row."""
        return self.drive.motion[:, 1]

    @cached_property
    def acceleration(self) -> Array:
        """Smoothed acceleration of each row."""
        return self.drive.motion[:, 2]

    @property
    def duration_s(self) -> float:
        """From the first row to the last."""
        return float(self.drive.t_s[-1] - self.drive.t_s[0])

    @property
    def period_s(self) -> float:
        """Median time between rows."""
        return self.drive.period_s

    def first_row(self, delay_s: float) -> FirstRow:
        """How the motion begins under a command that acts `delay_s` late."""
        return self._beginning.under(delay_s)

    @cached_property
    def _beginning(self) -> Beginning:
        drive = self.drive
        return beginning(Start.AUTO, drive.t_s, drive.torque, drive.position, drive.motion, free=False)


def dry_friction(model: AxisModel) -> float:
    """The model's Coulomb friction, N*m: the scale of every mismatch. Of a local map, the least; never nothing."""
    law = model.friction
    if law.kind == "local":
        return min(abs(torque) for torque in law.torques)
    return max(law.coulomb, 1e-9)
