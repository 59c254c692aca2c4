"""What an encoder's rounding and a drive's noise make of a joint: the swing that no law under test can rule out.

Beside the loop check; limits that are figures of performance, not of stability, are set above it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.parameters import LocalParameters
from servod.lab.simulate.noise import noise_of
from servod.lab.verify.closed_loop import LinearBristle, LoopDeviation, late_corners, loops_around
from servod.lab.verify.law_slopes import LawSlopes
from servod.lab.verify.margins import Sweep, joints_at
from servod.lab.verify.sampled import Array

RESPONSE_S = 1.5  # of the response that is summed: what is slower is the observer's, and far smaller
#: Counts that nothing tells apart, and the most that rounding excuses: a loop that hardly stands would excuse itself.
LEAST_COUNTS, MOST_COUNTS = 2.0, 8.0
NOISE_SWING = 7.0  # peak to peak over rms: noise of 40 Hz stays within +-3.5 sigma for 15 s
LEAST_STIFFNESS = 1e-9


def count_rad(design: Design) -> float:
    """Angle of one count of the encoder [rad]; 0 where it has no steps."""
    return 2.0 * math.pi / design.counts_per_turn if design.counts_per_turn else 0.0


def rounding_rad(sweep: Sweep, design: Design) -> float:
    """Peak to peak that rounding may make of a joint that slides at the sweep's speeds, in the worst corner [rad]."""
    if not design.counts_per_turn:
        return 0.0
    counts = swing_per_count(sweep, late_corners(design.uncertainty))
    return float(np.clip(counts, LEAST_COUNTS, MOST_COUNTS)) * count_rad(design)


def gives_way_rad(law: LocalParameters, design: Design) -> float:
    """Peak to peak by which noise of the torque moves a joint that slides, held by its feedback alone [rad]."""
    noise = noise_of(design.model)
    if noise is None:
        return 0.0
    stiffness = law.input_scale_nm * min(law.regions.low.k_x_per_rad, law.regions.high.k_x_per_rad)
    return NOISE_SWING * noise.torque_rms / max(stiffness, LEAST_STIFFNESS)


def swing_per_count(sweep: Sweep, cases: Sequence[LoopDeviation]) -> float:
    """Largest peak to peak position per count of the encoder, over `cases` of one delay sliding at the sweep's speeds.

    A reading is off by half a count to either side at most, whatever its course in time; a linear loop then moves by
    no more than the l1 norm of its response from reading to position, times that.
    """
    kinds = [(v, slopes) for v, slopes in sweep.coupled if v != 0.0]
    return max(float(_l1_norms(sweep, v, slopes, tuple(cases)).max()) for v, slopes in kinds)


def _l1_norms(sweep: Sweep, velocity: float, slopes: LawSlopes, cases: tuple[LoopDeviation, ...]) -> Array:
    """Sum of |position| after one reading that is off by 1, in each case."""
    timing = sweep.timing
    plant_a, plant_b, filtered = joints_at(sweep.friction, velocity, LinearBristle.SLIDES, cases, timing)
    closed, column, row = loops_around(plant_a, plant_b, filtered, slopes)
    n, law = plant_a.shape[-1], np.zeros_like(closed)
    law[:, n:] = closed[:, n:]
    seen = [column * row[i] + law[:, :, i] for i in (0, filtered)]
    state, total = np.zeros(column.shape), np.zeros(len(column))
    read, rate = 1.0, (1.0 - timing.kept) / timing.period_s
    for k in range(round(RESPONSE_S / timing.period_s)):
        off = rate if k == 0 else -rate * timing.kept ** (k - 1) * (1.0 - timing.kept)
        state = np.matmul(closed, state[:, :, None])[:, :, 0] + seen[0] * read + seen[1] * off
        total += np.abs(state[:, 0])
        read = 0.0
    return total


# --- The width of rest -----------------------------------------------------------------------------------------------
# What may count as a joint at rest: the width that rounding and noise of the encoder make, and no more. Synthesis takes
# the widths from here, and verification compares a set with them: within the width most of the feedback is off, so a
# set that calls more of its travel rest is another law than the one judged.


HOLD_COUNTS = 0.6  # hold width in encoder counts: what rounding hides, and no more, for the joint creeps as far
REST_SIGMAS = 5.0  # of the encoder's noise, beyond the hold width, within which a joint counts as at rest
#: Of feedback and observer: with less a joint creeps under a load for seconds, and its noise hunts instead.
LEAST_SHARE = 0.2


def hold_width(design: Design) -> float:
    """Error that rounding alone may hide [rad]; 0 where the encoder has no steps."""
    return HOLD_COUNTS * count_rad(design)


def rest_width(design: Design) -> float:
    """Error that rounding and noise of the encoder may show of a joint that stands where it shall [rad]."""
    noise = noise_of(design.model, count_rad(design))
    return hold_width(design) + (REST_SIGMAS * noise.encoder_rms if noise else 0.0)
