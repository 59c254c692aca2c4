"""Feedback of a sound drive and encoder, to be changed in one value, and numbers beside a limit."""

from __future__ import annotations

import math
from typing import Any

from servod.hal import AmplifierFeedback, DriveState, EncoderFeedback, Reason

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
