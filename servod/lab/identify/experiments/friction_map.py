"""Sines of position under PD: the friction-velocity map, from millirad per second up.

Reason: in slow motion the torque is the friction (the paper's Fig. 8). Sines of rising peak velocity cover the whole
speed range in both directions; the large travel of the faster ones shows what repeats with position. Where friction
falls with speed, no feedback over a bus can hold a joint at constant speed; it is crossed instead, quickly enough that
stick-slip does not build up, slowly enough that the bristles keep up. A share of the break-away torque is fed forward,
so that the joint follows at once. Bounds: travel and speed by the sines' amplitudes; the window ends it on a jam.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servod.lab.identify.experiments.common import Bench
from servod.lab.identify.fits.break_away import BreakAwayFit
from servod.lab.identify.shapes import sine
from servod.lab.identify.trace import ExperimentKind, RecordedMotion


class TestSine(NamedTuple):
    """One sine: peak velocity, amplitude, periods."""

    peak_rad_s: float
    amplitude_rad: float
    turns: int


#: Lowest peak velocity, in rad/s; the map begins at a third of it.
SLOWEST_RAD_S = 0.006
#: Peak velocities rise by this factor.
RATIO = 3.2
#: No sine is faster than this: beyond, inertia and delay would weigh more than friction.
HIGHEST_HZ = 0.6
LONGEST_PERIOD_S = 9.0
TURNS = 2
#: Crossings: peak velocity, periods, and accelerations as shares of v^2/z at SLOW_CROSSING_RAD_S, z the bristle's way.
CROSSING_RAD_S, CROSSING_TURNS, CROSSING_SHARES, SLOW_CROSSING_RAD_S = 0.25, (9, 9, 24), (0.12, 0.3, 0.8), 0.02
#: Share of break-away that is fed forward, full from this share of the peak velocity on.
FORWARD_SHARE, FORWARD_FROM = 0.8, 0.05


def plan(bench: Bench, break_away_rad: float) -> list[TestSine]:
    """The sines, slowest first, up to the allowed speed or what the travel permits; then the crossings."""
    travel = bench.bounds.travel_rad
    fastest = min(bench.bounds.speed_rad_s, 2.0 * np.pi * HIGHEST_HZ * travel)
    count = max(2, 1 + round(np.log(fastest / SLOWEST_RAD_S) / np.log(RATIO)))
    peaks = np.geomspace(SLOWEST_RAD_S, fastest, count)
    sines = [TestSine(float(p), float(min(p * LONGEST_PERIOD_S / (2.0 * np.pi), travel)), TURNS) for p in peaks]
    peak = min(CROSSING_RAD_S, fastest)
    for share, turns in zip(CROSSING_SHARES, CROSSING_TURNS, strict=True):
        acceleration = share * SLOW_CROSSING_RAD_S**2 / break_away_rad
        sines.append(TestSine(peak, float(min(peak**2 / acceleration, travel)), turns))
    return sines


def run(
    bench: Bench, gains: tuple[float, float], break_away: BreakAwayFit, break_away_rad: float
) -> list[RecordedMotion]:
    """All sines, each its own recording; `break_away_rad` is the bristles' way, break-away over stiffness."""
    traces = []
    for wanted in plan(bench, break_away_rad):
        start_rad = bench.bounds.centre_rad - wanted.amplitude_rad
        bench.go_to(start_rad, gains, max(wanted.peak_rad_s, 0.3 * bench.bounds.speed_rad_s))
        path, velocity = sine(wanted.amplitude_rad, wanted.peak_rad_s, wanted.turns, bench.period_s)
        share = FORWARD_SHARE * np.clip(velocity / (FORWARD_FROM * wanted.peak_rad_s), -1.0, 1.0)
        forward = share * np.where(velocity > 0.0, break_away.positive.value, break_away.negative.value)
        settings = {"peak_rad_s": wanted.peak_rad_s, "kp": gains[0], "kd": gains[1]}
        traces.append(bench.run(ExperimentKind.FRICTION_MAP, path, forward, bench.bounds.window_rad, settings))
    return traces
