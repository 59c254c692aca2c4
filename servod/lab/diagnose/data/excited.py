"""What recordings can tell at all: effects that only an axis in swift motion shows, or one that goes both ways.

Stands between the traces and the selection. On an axis that creeps under a command spent on friction and cogging, what
scales, limits or delays the command, or acts on the mass, shows next to nothing; a fit that may use it makes the
command mean nothing and so explains everything.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servod.lab.diagnose.data.trace import Trace

#: Inertia must take this share of the command (root mean squares) before swift effects can be told; on an axis that
#: goes both ways, whose command swings with its friction, less will do.
LEAST_INERTIAL, LEAST_BOTH_WAYS = 0.15, 0.02

#: Share of the rows, at most, in which an axis that creeps may do otherwise: it had to get there.
OTHERWISE = 0.05

#: Share of rows that must go either way before effects that tell one direction from the other can be told.
LEAST_EITHER_WAY = 0.05

#: Share of a high speed from which a row goes a way.
GOES = 0.1


def one_way(traces: Sequence[Trace]) -> bool:
    """Whether the axis hardly goes one of its two ways."""
    speed = np.concatenate([trace.velocity[trace.counts] for trace in traces])
    goes = GOES * float(np.quantile(np.abs(speed), 0.98))
    return min(float(np.mean(speed > goes)), float(np.mean(speed < -goes))) < LEAST_EITHER_WAY


def creeps(traces: Sequence[Trace], inertia: float) -> bool:
    """Whether the command of an axis of this inertia goes into friction and cogging alone."""
    needed = np.abs(np.concatenate([inertia * trace.acceleration[trace.counts] for trace in traces]))
    needed = np.minimum(needed, np.quantile(needed, 1.0 - OTHERWISE))
    command = np.concatenate([trace.drive.torque[trace.counts] for trace in traces])
    least = LEAST_INERTIAL if one_way(traces) else LEAST_BOTH_WAYS
    return float(np.sqrt(np.mean(needed**2))) < least * float(np.sqrt(np.mean(command**2)))
