"""Feedback of a sound drive and encoder, limits that it may reach, and numbers beside a limit."""

from __future__ import annotations

import math
from typing import Any

from servod.formats.config import LimitsConfig
from servod.runtime.fieldbus.devices import AmplifierFeedback, DriveState, EncoderFeedback, Reason

#: Powers of two, so that sums and products in here are exact.
CONFIG = LimitsConfig(
    torque_nm=0.5,
    torque_rate_nm_per_s=64.0,
    speed_rad_s=4.0,
    position_min_rad=-1.0,
    position_max_rad=2.0,
    following_error_rad=0.25,
    encoder_mismatch_rad=0.125,
    stale_cycles=3,
    late_cycles=4,
)
NAN, INF = math.nan, math.inf
NOT_FINITE = (NAN, INF, -INF)


def amplifier(**changes: Any) -> AmplifierFeedback:
    """An enabled drive, heard in this cycle."""
    sound = AmplifierFeedback(
        0, 0, DriveState.OPERATION_ENABLED, 0x0237, 10, 0.0, 0.0, 0, goal_reached=True, reasons=Reason.NONE
    )
    return sound._replace(**changes)


def encoder(**changes: Any) -> EncoderFeedback:
    """An encoder at zero and at rest, heard in this cycle."""
    return EncoderFeedback(0, 0, 0.0, 0.0, 0)._replace(**changes)


def above(value: float) -> float:
    """The next number that is farther from zero."""
    return math.nextafter(value, math.copysign(INF, value))


def below(value: float) -> float:
    """The next number that is nearer to zero."""
    return math.nextafter(value, 0.0)
