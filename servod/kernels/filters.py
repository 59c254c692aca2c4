"""The first-order low-pass behind every velocity: its step and its lag, for driver, simulator and design alike."""

from __future__ import annotations

import math


def low_pass_share(cutoff_hz: float, step_s: float) -> float:
    """`a` of y += a (x - y) for a first-order low-pass, exact for an input held over `step_s`: 1 - exp(-2 pi f T)."""
    return 1.0 - math.exp(-2.0 * math.pi * cutoff_hz * step_s)


def velocity_delay_s(period_s: float, cutoff_hz: float) -> float:
    """How far the low-passed difference of positions lags the true velocity at low frequency, in s.

    Half the differentiation span plus the group delay at DC of y += a (x - y): T (1 - a) / a.
    """
    share = low_pass_share(cutoff_hz, period_s)
    return period_s * (0.5 + (1.0 - share) / share)
