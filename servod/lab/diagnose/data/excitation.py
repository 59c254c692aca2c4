"""What recordings can tell at all: effects that only an axis in swift motion shows, or one that goes both ways.

Stands between the traces and the selection. On an axis that creeps under a command spent on friction and cogging, what
scales, limits or delays the command, or acts on the mass, shows next to nothing; a fit that may use it makes the
command mean nothing and so explains everything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servod.lab.diagnose.data.trace import CheckedTrace
from servod.lab.diagnose.settings import SETTINGS


def unidirectional(traces: Sequence[CheckedTrace]) -> bool:
    """Whether the axis hardly goes one of its two ways."""
    speed = np.concatenate([trace.velocity[trace.counts] for trace in traces])
    goes = SETTINGS.excitation.moving_speed * float(np.quantile(np.abs(speed), 0.98))
    return min(float(np.mean(speed > goes)), float(np.mean(speed < -goes))) < SETTINGS.excitation.least_either_way


def creeps(traces: Sequence[CheckedTrace], inertia: float) -> bool:
    """Whether the command of an axis of this inertia goes into friction and cogging alone."""
    needed = np.abs(np.concatenate([inertia * trace.acceleration[trace.counts] for trace in traces]))
    needed = np.minimum(needed, np.quantile(needed, 1.0 - SETTINGS.excitation.otherwise))
    command = np.concatenate([trace.drive.torque[trace.counts] for trace in traces])
    least = SETTINGS.excitation.least_inertial if unidirectional(traces) else SETTINGS.excitation.least_both_ways
    return float(np.sqrt(np.mean(needed**2))) < least * float(np.sqrt(np.mean(command**2)))
