"""Kicks: a short torque pulse in each direction, for a first idea of inertia.

Reason: the feedback of all later experiments is set from it. Amplitude: a multiple of break-away; the pulse's duration
is doubled from one period until the joint reaches a useful speed, and its torque grows where a longer pulse makes the
joint no faster: viscous friction carries it, or a hill of cogging holds it. It is doubled never so far that the next
kick would pass the allowed speed, as the kick before tells; a stronger one begins again with a quarter of the length,
for what held the joint may not hold it then. Bounds: speed, torque and a window; friction alone stops the joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servod.common.errors import AnswerIsNo
from servod.lab.identify.experiments.common import SPEED_SPAN_S, Bench, peak_speed
from servod.lab.identify.shapes import samples
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

#: Torque against break-away: of the first kick, the step by which it grows, the least step near the bound.
TORQUE_RATIO, TORQUE_STEP, LEAST_STEP = 1.6, 1.25, 1.05
#: A pulse twice as long that makes the joint no faster than by this factor is long enough, where the encoder shows the
#: slower of both by so many counts.
LEVELS_OFF, LEAST_COUNTS = 1.3, 4.0
#: A stronger pulse is at first this many times shorter, and is tried where so many times the speed is allowed.
SHORTER, STEP_ROOM = 4, 2.0
#: Shorter pulses are over before the fit can tell inertia from bristles; longer ones are no kicks.
LEAST_S, LONGEST_S = 0.004, 1.0
#: Fast enough: this share of the allowed speed, and so many counts per period.
SPEED_SHARE, SPEED_COUNTS = 0.12, 4.0
#: Speed grows with the pulse's duration, and by up to this factor more once the bristles have given way.
GROWTH = 1.2
#: The whole motion stays in this share of the travel.
TRAVEL_SHARE = 0.25
LEAD_S, COAST_S = 0.05, 0.35


@dataclass(frozen=True)
class _Pulse:
    """Torque against break-away, duration in periods, and the speed that half of that reached; 0.0: not tried."""

    ratio: float = TORQUE_RATIO
    periods: int = 1
    before_rad_s: float = 0.0


def run(bench: Bench, break_away_nm: tuple[float, float]) -> list[RecordedMotion]:
    """Kicks of growing length there and back until both directions tell; `break_away_nm` positive, negative.

    Raises AnswerIsNo when they cannot: bounds, encoder or torque forbid it.
    """
    needed_rad_s, kicks = _needed(bench), []
    pulses = {sign * size: _Pulse() for sign, size in zip((1.0, -1.0), break_away_nm, strict=True)}
    while pulses:
        for torque_nm, pulse in list(pulses.items()):
            kick = _kick(bench, torque_nm, pulse)
            kicks.append(kick)
            if pulse.periods * bench.period_s >= LEAST_S and peak_speed(kick, SPEED_SPAN_S) >= needed_rad_s:
                del pulses[torque_nm]
            else:
                pulses[torque_nm] = _next(bench, kick, pulse, abs(torque_nm), needed_rad_s)
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


def _next(bench: Bench, kick: RecordedMotion, pulse: _Pulse, break_away_nm: float, needed_rad_s: float) -> _Pulse:
    """The next pulse: twice as long, or stronger where length does not help, as far as speed and torque allow it.

    Raises AnswerIsNo when none is allowed.
    """
    # the shortest kicks do not fill the usual span
    reached, allowed = peak_speed(kick, 0.5 * SPEED_SPAN_S), bench.bounds.most_rad_s
    factor = allowed / (GROWTH * reached) if reached > 0.0 else math.inf
    at_longest = 2 * pulse.periods * bench.period_s > LONGEST_S
    shown_rad_s = LEAST_COUNTS * bench.resolution_rad / (0.5 * SPEED_SPAN_S)
    levels_off = shown_rad_s < pulse.before_rad_s and reached < LEVELS_OFF * pulse.before_rad_s
    if factor >= STEP_ROOM and (at_longest or levels_off):
        ratio = min(TORQUE_STEP * pulse.ratio, bench.bounds.torque_nm / break_away_nm)
        if ratio > LEAST_STEP * pulse.ratio:
            return _Pulse(ratio, 1 if at_longest else max(1, pulse.periods // SHORTER))
    longest = math.floor(pulse.periods * min(factor, 2.0))
    if longest <= pulse.periods:
        raise AnswerIsNo(
            f"inertia is not identifiable at this speed: a kick of {1e3 * kick.settings['pulse_s']:.2g} ms takes the "
            f"joint to {reached:.2g} rad/s, {allowed:.2g} are allowed, and it must last {1e3 * LEAST_S:g} ms and "
            f"reach {needed_rad_s:.2g} rad/s to tell; allow more (--speed, limits.speed_rad_s)"
        )
    if at_longest:
        raise AnswerIsNo(
            f"the joint does not pick up speed when kicked: {reached:.2g} rad/s, and {needed_rad_s:.2g} are needed to "
            "tell; its inertia or friction is too large for the allowed torque (limits.torque_nm) or the experiments "
            "are to be too fast (--speed), its travel is too short (--travel, limits.position_min_rad and "
            "position_max_rad), or its encoder is too coarse"
        )
    return _Pulse(pulse.ratio, longest, reached if longest == 2 * pulse.periods else 0.0)


def _kick(bench: Bench, torque_nm: float, pulse: _Pulse) -> RecordedMotion:
    """One kick in the direction of `torque_nm`, the break-away there, and the coast behind it."""
    bench.set_gains(0.0, 0.0)
    size = np.sign(torque_nm) * min(pulse.ratio * abs(torque_nm), bench.bounds.torque_nm)
    pulse_s, lead = pulse.periods * bench.period_s, samples(LEAD_S, bench.period_s)
    torque = np.zeros(lead + pulse.periods + samples(COAST_S + pulse_s, bench.period_s))
    torque[lead : lead + pulse.periods] = size
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
