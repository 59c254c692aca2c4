"""The motions under which gain sets are compared: trajectory (19), then two steps that are held for a long time.

Stands on the loop's own reference functions, so that simulator and axis follow the same numbers.
"""

from __future__ import annotations

import numpy as np

from servod.lab.tracking.metrics import Array
from servod.runtime.loop.references import paper

PAPER_S = 30.0
#: Steps one after the other, in this order and the same direction, each from where the last is held.
STEPS_MRAD = (100.0, 10.0)
HOLD_S = 20.0
#: Rest before the first motion: a change of gains fades out.
REST_S = 1.0


def paper_rows(period_s: float, duration_s: float = PAPER_S) -> Array:
    """Trajectory (19) as the simulator reads it: rows of position, velocity and acceleration, from rest."""
    samples = round(duration_s / period_s)
    return np.array([paper((k + 1) * period_s) for k in range(samples)])


def step_rows(period_s: float, step_mrad: float, duration_s: float = HOLD_S) -> Array:
    """A step from 0, held from the first sample on."""
    rows = np.zeros((round(duration_s / period_s), 3))
    rows[:, 0] = step_mrad * 1e-3
    return rows
