"""Kicks: a short torque pulse in each direction, for a first idea of inertia.

Reason: the feedback of all later experiments is set from it. Amplitude: a fixed multiple of break-away; its duration is
doubled from one period until the joint reaches a useful speed, and never so far that the next kick would pass the
allowed one, which is known from the kick before. Bounds: speed and a window; friction alone stops the joint.
"""

from __future__ import annotations

import math

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.lab.identify.experiments.common import SPEED_SPAN_S, Bench, peak_speed
from servod.lab.identify.shapes import samples
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

#: Torque against break-away.
TORQUE_RATIO = 1.6
#: Shorter pulses are over before the fit can tell inertia from bristles; longer ones are no kicks.
LEAST_S, LONGEST_S = 0.004, 1.0
#: Fast enough: this share of the allowed speed, and so many counts per period.
SPEED_SHARE, SPEED_COUNTS = 0.12, 4.0
#: Speed grows with the pulse's duration, and by up to this factor more once the bristles have given way.
GROWTH = 1.2
#: The whole motion stays in this share of the travel.
TRAVEL_SHARE = 0.25
LEAD_S, COAST_S = 0.05, 0.35


def run(bench: Bench, break_away_nm: tuple[float, float]) -> list[RecordedMotion]:
    """Kicks of growing length there and back until both directions tell; `break_away_nm` positive, negative.

    Raises AnswerIsNo when they cannot: bounds, encoder or torque forbid it.
    """
    needed_rad_s, kicks = _needed(bench), []
    pulses = {sign * size: 1 for sign, size in zip((1.0, -1.0), break_away_nm, strict=True)}
    while pulses:
        for torque_nm, pulse in list(pulses.items()):
            kick = _kick(bench, torque_nm, pulse)
            kicks.append(kick)
            if pulse * bench.period_s >= LEAST_S and peak_speed(kick, SPEED_SPAN_S) >= needed_rad_s:
                del pulses[torque_nm]
            else:
                pulses[torque_nm] = _longer(bench, kick, pulse, needed_rad_s)
    return kicks


def _needed(bench: Bench) -> float:
    """Speed that a kick must reach, in rad/s. Raises AnswerIsNo when the encoder cannot show one that is allowed."""
    allowed = bench.bounds.most_rad_s
    visible = SPEED_COUNTS * bench.resolution_rad / bench.period_s
    if visible > allowed:
        counts = math.ceil(SPEED_COUNTS * 2.0 * np.pi / (allowed * bench.period_s))
        raise AnswerIsNo(
            f"inertia is not identifiable at this speed with this encoder: it shows kicks from {visible:.2g} rad/s on, "
            f"{allowed:.2g} are allowed; allow more (--speed, limits.speed_rad_s), or fit one of {counts} counts a turn"
        )
    return max(SPEED_SHARE * bench.bounds.speed_rad_s, visible)


def _longer(bench: Bench, kick: RecordedMotion, pulse: int, needed_rad_s: float) -> int:
    """Periods of the next pulse: twice as many, as far as the speed allows it. Raises AnswerIsNo when none does."""
    # the shortest kicks do not fill the usual span
    reached, allowed = peak_speed(kick, 0.5 * SPEED_SPAN_S), bench.bounds.most_rad_s
    longest = math.floor(pulse * allowed / (GROWTH * reached)) if reached > 0.0 else 2 * pulse
    if longest <= pulse:
        raise AnswerIsNo(
            f"inertia is not identifiable at this speed: a kick of {1e3 * kick.settings['pulse_s']:.2g} ms takes the "
            f"joint to {reached:.2g} rad/s, {allowed:.2g} are allowed, and it must last {1e3 * LEAST_S:g} ms and "
            f"reach {needed_rad_s:.2g} rad/s to tell; allow more (--speed, limits.speed_rad_s)"
        )
    if 2 * pulse * bench.period_s > LONGEST_S:
        raise AnswerIsNo(
            f"the joint does not pick up speed when kicked: {reached:.2g} rad/s, and {needed_rad_s:.2g} are needed to "
            "tell; its inertia is too large for the allowed torque (limits.torque_nm), its travel is too short "
            "(--travel, limits.position_min_rad and position_max_rad), or its encoder is too coarse"
        )
    return min(2 * pulse, longest)


def _kick(bench: Bench, torque_nm: float, pulse: int) -> RecordedMotion:
    """One kick of `pulse` periods in the direction of `torque_nm`, the break-away there, and the coast behind it."""
    bench.set_gains(0.0, 0.0)
    size = np.sign(torque_nm) * min(TORQUE_RATIO * abs(torque_nm), bench.bounds.torque_nm)
    pulse_s, lead = pulse * bench.period_s, samples(LEAD_S, bench.period_s)
    torque = np.zeros(lead + pulse + samples(COAST_S + pulse_s, bench.period_s))
    torque[lead : lead + pulse] = size
    window = min(TRAVEL_SHARE * bench.bounds.travel_rad, bench.bounds.window_rad)
    return bench.run(ExperimentKind.KICK, np.zeros(len(torque)), torque, window, {"pulse_nm": size, "pulse_s": pulse_s})


# --- Noise at rest ---------------------------------------------------------------------------------------------------
# Noise at rest: what encoder and torque reading show while nothing moves and no torque is asked for. Reason: the noise
# floor bounds what all other experiments can see. Bounds: no torque, no motion.


DURATION_S = 1.5


def run_noise(bench: Bench) -> RecordedMotion:
    """Record a rest under zero gains."""
    still = np.zeros(samples(DURATION_S, bench.period_s))
    bench.set_gains(0.0, 0.0)
    return bench.run(ExperimentKind.NOISE, still, still, bench.bounds.window_rad, {})
