"""Break-away torque in each direction, from ramps that ended when the joint began to slide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.lab.identify.estimate import Estimate, estimate
from servod.lab.identify.trace import RecordedMotion

#: The joint creeps up to half the window while the torque comes within a per cent of break-away, and begins to slide
#: there; the command takes a cycle or two to act.
LEAD_S = 0.002

#: Share of the value that the ramps' scatter does not show: creep before, and the fall into sliding.
ALLOWANCE = 0.03


class BreakAwayFit(NamedTuple):
    """Torque magnitudes at which sliding begins, N*m, for positive and negative torque."""

    positive: Estimate
    negative: Estimate

    @property
    def weaker(self) -> float:
        """The smaller of both."""
        return min(self.positive.value, self.negative.value)


def torque_of(ramp: RecordedMotion) -> float:
    """Torque magnitude at the break-away of one ramp; NaN when the joint stayed."""
    away = np.abs(ramp.position_rad - ramp.position_rad[0]) > 0.5 * ramp.settings["window_rad"]
    if not away.any():
        return float("nan")
    row = int(np.argmax(away)) - round(LEAD_S / ramp.period_s)
    return abs(float(ramp.torque_nm[max(row, 0)]))


def fit(ramps: Sequence[RecordedMotion]) -> BreakAwayFit:
    """Mean and spread over the ramps of each direction. Raises AnswerIsNo when a direction has none."""
    return BreakAwayFit(*(_direction(ramps, sign) for sign in (1.0, -1.0)))


def widened(found: BreakAwayFit, half_nm: float) -> BreakAwayFit:
    """Intervals that hold wherever the joint stands, given what cogging and noise add or take (`half_nm`)."""
    wider = [np.hypot(each.half_width, half_nm) for each in found]
    return BreakAwayFit(
        *(
            replace(each, low=each.value - w, high=each.value + w)
            for each, w in zip(found, map(float, wider), strict=True)
        )
    )


def _direction(ramps: Sequence[RecordedMotion], sign: float) -> Estimate:
    torques = np.array([torque_of(r) for r in ramps if r.settings["direction"] == sign])
    torques = torques[np.isfinite(torques)]
    if len(torques) == 0:
        raise AnswerIsNo(f"no recorded ramp of {'positive' if sign > 0.0 else 'negative'} torque broke away")
    note = "where the joint stood; it differs with position where the axis cogs"
    if len(torques) == 1:
        return estimate(float(torques[0]), 0.0, 1.0, "N*m", share=0.1, note="one ramp only; " + note)
    deviation = float(np.std(torques, ddof=1)) / np.sqrt(len(torques))
    return estimate(float(np.mean(torques)), deviation, len(torques) - 1, "N*m", share=ALLOWANCE, note=note)
