"""Kicks: a short torque pulse in each direction, for a first idea of inertia.

Reason: the feedback of all later experiments is set from it. Amplitude: a fixed multiple of break-away; its duration is
doubled from a few milliseconds until the joint reaches a useful speed. Bounds: speed and a window; friction alone stops
the joint.
"""

from __future__ import annotations

import numpy as np

from servod.errors import AnswerIsNo
from servod.identify.experiments.common import Bench
from servod.identify.shapes import samples
from servod.identify.trace import Kind, Trace

#: Torque against break-away, first and longest duration.
TORQUE_RATIO = 1.6
FIRST_S, LONGEST_S = 0.004, 1.0
#: Fast enough: this share of the allowed speed, or so many counts per period.
SPEED_SHARE, SPEED_COUNTS = 0.12, 4.0
#: The whole motion stays in this share of the travel.
TRAVEL_SHARE = 0.25
LEAD_S, COAST_S = 0.05, 0.35


def run(bench: Bench, break_away_nm: tuple[float, float]) -> list[Trace]:
    """Kicks of growing length there and back until they are fast enough; `break_away_nm` positive, negative."""
    duration_s, kicks = FIRST_S, []
    while duration_s <= LONGEST_S:
        kicks = [_kick(bench, sign * size, duration_s) for sign, size in zip((1.0, -1.0), break_away_nm, strict=True)]
        if all(_fast_enough(bench, kick) for kick in kicks):
            return kicks
        duration_s *= 2.0
    raise AnswerIsNo("the joint does not pick up speed when kicked; its inertia is too large for the allowed torque")


def _kick(bench: Bench, torque_nm: float, duration_s: float) -> Trace:
    bench.set_gains(0.0, 0.0)
    size = np.sign(torque_nm) * min(TORQUE_RATIO * abs(torque_nm), bench.bounds.torque_nm)
    lead, push = samples(LEAD_S, bench.period_s), samples(duration_s, bench.period_s)
    torque = np.zeros(lead + push + samples(COAST_S + duration_s, bench.period_s))
    torque[lead : lead + push] = size
    window = min(TRAVEL_SHARE * bench.bounds.travel_rad, bench.bounds.window_rad)
    return bench.run(Kind.KICK, np.zeros(len(torque)), torque, window, {"pulse_nm": size, "pulse_s": duration_s})


def _fast_enough(bench: Bench, kick: Trace) -> bool:
    span = samples(0.004, bench.period_s)
    fastest = float(np.max(np.abs(kick.position_rad[span:] - kick.position_rad[:-span]))) / (span * bench.period_s)
    return fastest >= SPEED_SHARE * bench.bounds.speed_rad_s and (
        fastest * bench.period_s >= SPEED_COUNTS * bench.resolution_rad
    )
