"""Presliding sine: the joint is rocked below break-away, so that only the bristles bend.

Reason: the slope of torque over displacement is the bristle stiffness c0 (the paper's Dahl curve, Fig. 7). Amplitude: a
share of the break-away torque found before; more for a coarse encoder, so that the motion is counts, not less than one.
Frequency: some Hz; at 1 Hz and below torque noise makes the bristles creep and the joint looks softer than it is, far
above, bristle damping and inertia take part. Bounds: below break-away nothing slides; a window ends it if it does.
Between bursts a nudge moves the joint by a random way, so that each burst meets the encoder's steps elsewhere.
"""

from __future__ import annotations

import numpy as np

from servod.lab.identify.experiments.common import Bench
from servod.lab.identify.shapes import fade_in, multisine, samples, times
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

FREQUENCY_HZ = 8.0
FADE_IN_S = 0.25
CYCLES = 6
#: A little more than whole cycles, so that the last one is whole whatever the first command cost.
TAIL_S = 0.005
#: Amplitude as a share of the weaker break-away torque; the larger one for a coarse encoder.
SHARE, COARSE_SHARE = 0.4, 0.62
#: Fewer counts than this from peak to peak at the smaller share call for the larger one.
ENOUGH_COUNTS = 6.0
WINDOW_COUNTS, WINDOW_RAD = 12.0, 1e-3


def burst(bench: Bench, break_away_nm: float, share: float) -> RecordedMotion:
    """One burst at the present position; `break_away_nm` of the weaker direction."""
    bench.set_gains(0.0, 0.0)
    duration_s = FADE_IN_S + CYCLES / FREQUENCY_HZ + TAIL_S
    t = times(duration_s, bench.period_s)
    torque = share * break_away_nm * fade_in(t, FADE_IN_S) * np.sin(2.0 * np.pi * FREQUENCY_HZ * t)
    window = max(WINDOW_RAD, WINDOW_COUNTS * bench.resolution_rad)
    settings = {"frequency_hz": FREQUENCY_HZ, "from_s": FADE_IN_S, "cycles": CYCLES, "share": share}
    return bench.run(ExperimentKind.PRESLIDING, np.zeros(len(t)), torque, window, settings)


def share_for(bench: Bench, peak_to_peak_rad: float) -> float:
    """The share of break-away to use, from the motion that a burst at SHARE has shown."""
    return SHARE if peak_to_peak_rad >= ENOUGH_COUNTS * bench.resolution_rad else COARSE_SHARE


# --- Multisine below break-away --------------------------------------------------------------------------------------
# Multisine below break-away, up to where the joint rings on its bristles: the bristles' damping. Reason: damping shows
# only near the resonance of inertia on bristles, beyond 100 Hz for a small joint. Amplitude: a share of break-away that
# leaves room for the ringing. Bounds: a window, as for the presliding sine.


PERIOD_S, PERIODS = 1.0, 8
LOWEST_HZ, HIGHEST_HZ, LINES = 25.0, 230.0, 12
BRISTLE_SHARE = 0.25


def run(bench: Bench, break_away_nm: float) -> RecordedMotion:
    """Record some periods at rest; `break_away_nm` of the weaker direction."""
    count = samples(PERIOD_S, bench.period_s)
    lines = np.unique(np.round(np.linspace(LOWEST_HZ * PERIOD_S, HIGHEST_HZ * PERIOD_S, LINES))).astype(np.int64)
    lines = lines[lines < 0.4 * count]
    wave = multisine(lines, np.ones(len(lines)), count, bench.rng)
    wave *= BRISTLE_SHARE * break_away_nm / float(np.max(np.abs(wave)))
    torque = np.concatenate([np.tile(wave, PERIODS), np.zeros(5)])
    bench.set_gains(0.0, 0.0)
    bench.rest(0.5)  # the old feedback's torque dies away
    window = max(WINDOW_RAD, WINDOW_COUNTS * bench.resolution_rad)
    settings = {"count": float(count), "periods": float(PERIODS)}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(lines)}
    return bench.run(ExperimentKind.BRISTLE, np.zeros(len(torque)), torque, window, settings)
