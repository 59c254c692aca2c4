"""Multisine below break-away, up to where the joint rings on its bristles: the bristles' damping.

Reason: damping shows only near the resonance of inertia on bristles, beyond 100 Hz for a small joint. Amplitude: a
share of break-away that leaves room for the ringing. Bounds: a window, as for the presliding sine.
"""

from __future__ import annotations

import numpy as np

from servod.lab.identify.experiments import presliding
from servod.lab.identify.experiments.common import Bench
from servod.lab.identify.shapes import multisine, samples
from servod.lab.identify.trace import Kind, Trace

PERIOD_S, PERIODS = 1.0, 8
LOWEST_HZ, HIGHEST_HZ, LINES = 25.0, 230.0, 12
SHARE = 0.25


def run(bench: Bench, break_away_nm: float) -> Trace:
    """Record some periods at rest; `break_away_nm` of the weaker direction."""
    count = samples(PERIOD_S, bench.period_s)
    lines = np.unique(np.round(np.linspace(LOWEST_HZ * PERIOD_S, HIGHEST_HZ * PERIOD_S, LINES))).astype(np.int64)
    lines = lines[lines < 0.4 * count]
    wave = multisine(lines, np.ones(len(lines)), count, bench.rng)
    wave *= SHARE * break_away_nm / float(np.max(np.abs(wave)))
    torque = np.concatenate([np.tile(wave, PERIODS), np.zeros(5)])
    bench.set_gains(0.0, 0.0)
    bench.rest(0.5)  # the old feedback's torque dies away
    window = max(presliding.WINDOW_RAD, presliding.WINDOW_COUNTS * bench.resolution_rad)
    settings = {"count": float(count), "periods": float(PERIODS)}
    settings |= {f"line_{i}": float(line) for i, line in enumerate(lines)}
    return bench.run(Kind.BRISTLE, np.zeros(len(torque)), torque, window, settings)
