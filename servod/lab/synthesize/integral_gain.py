"""The local compensating gains l_i of (9), designed: the largest that the sampled loop stands with a stated margin.

Stands on the sweep that verification uses. l_i is integral action through the friction state, and the only one of a
law without output observer. Its sign makes z_hat push the way the feedback pushes; with the other one the loop is
unstable at every size (positive feedback around an integrator), so only l > 0 is looked for. How much a set may have
depends on its speed: creeping, where z_hat hardly leaks, 0.03 is the limit on the paper's joint, ten times that where
friction settles fast. One common gain would be that of the slowest set, and tracks a quarter worse.
"""

from __future__ import annotations

import bisect

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws import LAWS
from servod.lab.verify.checks import CORNER_DISK, DISK_LIMIT, speeds_of
from servod.lab.verify.closed_loop import late_corners
from servod.lab.verify.margins import Sweep
from servod.lab.verify.sampled import timing_of
from servod.lab.verify.steady_friction import SteadyFriction

#: Candidates [rad/s per unit of u* = u/K].
GAINS = (0.005, 0.007, 0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08, 0.11, 0.16, 0.23)
SPEEDS = 12  # per direction at which the largest gain is looked for; between them the smaller neighbour holds
MARGIN = 1.5 * DISK_LIMIT  # disk margin that is left
SHRINK, SHRINKS = 0.85, 12  # of all gains together, until the whole set stands


def with_gains(law: LocalParameters, speeds: list[float], gains: list[float]) -> LocalParameters:
    """`law` with l_i by the speed of each set, linear between `speeds` [rad/s] and held beyond them."""
    sets = [
        s.model_copy(update={"gain": float(np.interp(abs(s.velocity_rad_s), speeds, gains))}) for s in law.friction.sets
    ]
    return law.model_copy(update={"friction": law.friction.model_copy(update={"sets": sets})})


def stands(design: Design, friction: SteadyFriction, law: LocalParameters, speeds: list[float]) -> bool:
    """Whether the sampled loop is stable at every corner of the intervals with the margin, at rest and at `speeds`."""
    sweep = Sweep(LAWS["local"], law.pack(), friction, timing_of(design), speeds)
    late = late_corners(design.uncertainty)
    wide = sweep.disk_margin()[0] >= MARGIN and sweep.disk_margin(late)[0] >= CORNER_DISK
    return wide and sweep.worst(late).radius < 1.0


def largest_gain(design: Design, friction: SteadyFriction, law: LocalParameters, speed: float) -> float:
    """Largest common l of the candidates that the loop stands at `speed`; 0 when it stands none."""

    def too_much(index: int) -> bool:
        return not stands(design, friction, with_gains(law, [speed], [GAINS[index]]), [speed])

    index = bisect.bisect_left(range(len(GAINS)), True, key=too_much)
    return GAINS[index - 1] if index else 0.0


def designed(design: Design, friction: SteadyFriction, law: LocalParameters) -> LocalParameters:
    """`law` with its l_i designed: per speed the largest that stands, and all together still with the margin."""
    speeds = speeds_of(design, SPEEDS)
    largest = [largest_gain(design, friction, law, speed) for speed in speeds]
    held = [min(largest[max(i - 1, 0) : i + 2]) for i in range(SPEEDS)]
    dense = speeds_of(design, 2 * SPEEDS)
    for step in range(SHRINKS):
        candidate = with_gains(law, speeds, [SHRINK**step * gain for gain in held])
        if stands(design, friction, candidate, dense):
            return candidate
    return with_gains(law, speeds, [0.0] * SPEEDS)
