"""Noise at rest: what encoder and torque reading show while nothing moves and no torque is asked for.

Reason: the noise floor bounds what all other experiments can see. Bounds: no torque, no motion.
"""

from __future__ import annotations

import numpy as np

from servod.lab.identify.experiments.common import Bench
from servod.lab.identify.shapes import samples
from servod.lab.identify.trace import Kind, Trace

DURATION_S = 1.5


def run(bench: Bench) -> Trace:
    """Record a rest under zero gains."""
    still = np.zeros(samples(DURATION_S, bench.period_s))
    bench.set_gains(0.0, 0.0)
    return bench.run(Kind.NOISE, still, still, bench.bounds.window_rad, {})
