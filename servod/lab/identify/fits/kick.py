"""First idea of inertia and sliding friction from kicks: a torque pulse and the coast after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.lab.identify.trace import RecordedMotion, smooth

WIDTH_S = 0.0025
#: Delays that are tried, in periods.
DELAYS = np.arange(0.0, 4.01, 0.25)
#: Rows count as sliding from this share of the fastest speed on.
SLIDING_SHARE = 0.25


class KickFit(NamedTuple):
    """Rough values: inertia in kg*m^2, delay in s, sliding friction magnitudes in N*m."""

    inertia: float
    delay_s: float
    positive_nm: float
    negative_nm: float


def fit(kicks: Sequence[RecordedMotion]) -> KickFit:
    """Regression torque = inertia*acceleration + friction(direction) over sliding rows, over all delays tried.

    Of `kicks`, which grew until they told, the last of each direction counts. Raises AnswerIsNo when inertia does not
    come out positive.
    """
    last_kicks = list({np.sign(kick.settings["pulse_nm"]): kick for kick in kicks}.values())
    best = min((_with_delay(last_kicks, d * last_kicks[0].period_s) for d in DELAYS), key=lambda fitted: fitted[0])
    if best[1].inertia <= 0.0:
        raise AnswerIsNo("the kicked joint did not follow the torque; is the encoder the joint's own?")
    return best[1]


def _with_delay(kicks: Sequence[RecordedMotion], delay_s: float) -> tuple[float, KickFit]:
    design, torque = [], []
    for kick in kicks:
        s = smooth(kick.t_s, kick.torque_nm, kick.position_rad, delay_s, WIDTH_S)
        sign = np.sign(kick.settings["pulse_nm"])
        rows = s.velocity * sign > SLIDING_SHARE * np.max(s.velocity * sign)
        design.append(np.column_stack([s.acceleration, s.velocity > 0.0, s.velocity < 0.0])[rows])
        torque.append(s.torque[rows])
    a, b = np.concatenate(design).astype(float), np.concatenate(torque)
    values = np.linalg.lstsq(a, b, rcond=None)[0]
    residual = float(np.mean((b - a @ values) ** 2))
    return residual, KickFit(float(values[0]), delay_s, float(values[1]), -float(values[2]))
