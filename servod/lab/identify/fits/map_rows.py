"""Slow motions made ready for the friction map: smoothed, inertia taken off, cut into parts.

Between the recordings and the friction map's regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.lab.identify.trace import Smooth, Trace, smooth

Array = NDArray[np.float64]

#: Smoothing of torque and motion: s at the finest, and so many counts' worth of time for a coarse encoder.
NARROWEST_S, WIDEST_S, WIDTH_S_PER_RAD = 0.0015, 0.0035, 110.0
#: Rows further apart than so many widths of the smoothing say something new.
SPACING = 2.0
#: Smoothing of the velocity where nothing says that it changes more quickly.
CALM_S = 0.03
#: What the encoder's steps may make of the quick velocity, in counts over the smoothing.
QUICK_COUNTS = 0.3
#: Slower than this share of the slowest motion's peak, or than so many counts per second, is not on the map.
SLOWEST_SHARE, SLOWEST_COUNTS_PER_S = 0.4, 70.0
#: A joint follows its reference when its velocity is off by less than this share and so much more. Where it sticks and
#: slips, torque noise has chosen the moment, and the friction seen in between is biased: such rows weigh little.
FOLLOWS_SHARE, FOLLOWS_RAD_S, ASTRAY_WEIGHT = 0.4, 0.004, 0.01
#: Each stroke counts as this many independent parts.
PARTS = 3


class Motion(NamedTuple):
    """One motion on an even grid: velocity rad/s, position rad, friction plus cogging N*m, and its part's number.

    `way` is the distance from the row before, `smear` the way that the smoothing of torque takes in (one standard
    deviation), `weight` is less where the joint sticks and slips.
    """

    velocity: Array
    position: Array
    torque: Array
    part: NDArray[np.int64]
    way: Array
    smear: Array
    weight: Array
    spacing: int  # rows between two that say something new


def motions_from(traces: Sequence[Trace], inertia: float, delay_s: float) -> list[Motion]:
    """All motions; parts are numbered through."""
    motions, parts = [], 0
    for trace in traces:
        motion = _motion(trace, inertia, delay_s)
        motions.append(motion._replace(part=motion.part + parts))
        parts += int(motion.part.max(initial=-1)) + 1
    return motions


def slowest_rad_s(traces: Sequence[Trace]) -> float:
    """The lowest speed that the recordings can tell."""
    return max(SLOWEST_SHARE * min(t.settings["peak_rad_s"] for t in traces), coarse_rad_s(traces))


def coarse_rad_s(traces: Sequence[Trace]) -> float:
    """The speed at which the encoder's steps begin to hide the motion."""
    return SLOWEST_COUNTS_PER_S * max(t.settings["resolution_rad"] for t in traces)


def _motion(trace: Trace, inertia: float, delay_s: float) -> Motion:
    resolution = trace.settings["resolution_rad"]
    width = float(np.clip(WIDTH_S_PER_RAD * resolution, NARROWEST_S, WIDEST_S))
    calm = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, CALM_S)
    quick = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, width)
    step = max(1, round(0.5 * width / trace.period_s))
    grid = np.arange(np.searchsorted(quick.t_s, calm.t_s[0]), len(quick.t_s), step)
    grid = grid[quick.t_s[grid] <= calm.t_s[-1]]
    velocity = _velocity(quick.velocity[grid], np.interp(quick.t_s[grid], calm.t_s, calm.velocity), resolution, width)
    part = np.interp(quick.t_s[grid], calm.t_s, _parts(calm)).round().astype(np.int64)
    torque = quick.torque[grid] - inertia * quick.acceleration[grid]
    wanted = np.gradient(trace.reference_rad, trace.period_s)
    weight = _weight(velocity, np.interp(quick.t_s[grid], trace.t_s, wanted))
    spacing = max(1, round(SPACING * width / (step * trace.period_s)))
    way = np.abs(velocity) * step * trace.period_s
    return Motion(velocity, quick.position[grid], torque, part, way, np.abs(velocity) * width, weight, spacing)


def _weight(velocity: Array, wanted: Array) -> Array:
    """1 where the joint follows its reference, less where it sticks and slips."""
    off = np.abs(velocity - wanted) > FOLLOWS_SHARE * np.abs(wanted) + FOLLOWS_RAD_S
    weight: Array = np.where(off, ASTRAY_WEIGHT, 1.0)
    return weight


def _velocity(quick: Array, calm: Array, resolution: float, width_s: float) -> Array:
    """The calm velocity, and the quick one where it is off it by more than encoder steps make."""
    noise = QUICK_COUNTS * resolution / width_s
    chosen: Array = np.where(np.abs(quick - calm) > noise, quick, calm)
    return chosen


def _parts(s: Smooth) -> NDArray[np.int64]:
    """Number of the part of a stroke that each row belongs to."""
    turned = np.flatnonzero(np.diff(np.sign(s.velocity)) != 0.0) + 1
    stroke = np.zeros(len(s.velocity), dtype=np.int64)
    stroke[turned] = 1
    stroke = np.cumsum(stroke)
    counts = np.bincount(stroke)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    progress = (np.arange(len(stroke)) - starts[stroke]) / counts[stroke]
    part: NDArray[np.int64] = PARTS * stroke + np.minimum((PARTS * progress).astype(np.int64), PARTS - 1)
    return part
