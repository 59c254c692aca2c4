"""Rows of slow motion that show steady friction: smoothed, presliding and stick-slip left out.

Between the recordings and the friction map's regression.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from servod.identify.signals import Smooth, smooth
from servod.identify.trace import Trace

Array = NDArray[np.float64]

#: Smoothing as a share of the motion's period, and its ends in s.
WIDTH_SHARE, NARROWEST_S, WIDEST_S = 0.004, 0.004, 0.03
#: After a reversal the bristles settle over this many times break-away displacement.
PRESLIDING_LENGTHS = 4.5
#: Slower than this share of the slowest motion's peak, or than so many counts per second, is not on the map.
SLOWEST_SHARE, SLOWEST_COUNTS_PER_S = 0.3, 70.0
#: Where the quick velocity is off the smooth one by this share, the joint sticks and slips, and for a time around.
SLIP_SHARE, SLIP_AROUND_S = 0.25, 0.03
#: Smoothing of the quick velocity, and what encoder steps may make of it, in counts over that time.
QUICK_S, QUICK_COUNTS = 0.004, 0.3
#: The lag of the bristles behind velocity may shift it by this share at most; more is no steady friction.
MOST_SHIFT = 0.5
#: Each stroke counts as this many independent parts.
PARTS = 3


class Rows(NamedTuple):
    """Regression rows: velocity rad/s, position rad, friction plus cogging N*m, and the part each row belongs to.

    The velocity is the one whose steady friction acts: the bristles follow with the way z behind them, so that while
    the joint accelerates by a, friction is that of v - a*z/|v| (first order of the bristle equation, the paper's (18)).
    """

    velocity: Array
    position: Array
    torque: Array
    part: NDArray[np.int64]


def rows_from(traces: Sequence[Trace], inertia: float, delay_s: float, break_away_rad: float) -> Rows:
    """Rows of all motions; inertia's torque is taken off. `break_away_rad` is static friction over stiffness."""
    slowest = max(
        SLOWEST_SHARE * min(t.settings["peak_rad_s"] for t in traces),
        SLOWEST_COUNTS_PER_S * max(t.settings["resolution_rad"] for t in traces),
    )
    pieces, parts = [], 0
    for trace in traces:
        piece = _rows(trace, inertia, delay_s, break_away_rad, slowest)
        pieces.append(piece._replace(part=piece.part + parts))
        parts += int(piece.part.max(initial=-1)) + 1
    return Rows(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))


def _rows(trace: Trace, inertia: float, delay_s: float, break_away_rad: float, slowest: float) -> Rows:
    period_of_motion = float(np.pi * np.ptp(trace.reference_rad) / trace.settings["peak_rad_s"])
    width = float(np.clip(WIDTH_SHARE * period_of_motion, NARROWEST_S, WIDEST_S))
    s = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, width)
    stroke, way = strokes_of(s)
    speed = np.maximum(np.abs(s.velocity), 1e-9)
    shift = s.acceleration * break_away_rad / speed
    slides = (speed - np.sign(s.velocity) * shift > slowest) & (way > PRESLIDING_LENGTHS * break_away_rad)
    slides &= np.abs(shift) < MOST_SHIFT * speed
    slides &= ~_slips(trace, s, delay_s)
    slides &= np.arange(len(s.t_s)) % max(1, round(width / trace.period_s)) == 0
    part = PARTS * stroke + np.minimum((PARTS * _progress(stroke)).astype(np.int64), PARTS - 1)
    torque = s.torque - inertia * s.acceleration
    return Rows((s.velocity - shift)[slides], s.position[slides], torque[slides], part[slides])


def _slips(trace: Trace, s: Smooth, delay_s: float) -> NDArray[np.bool_]:
    """Rows in or near stick-slip: the quick velocity swings away from the smooth one, beyond the encoder's noise."""
    quick = smooth(trace.t_s, trace.torque_nm, trace.position_rad, delay_s, QUICK_S)
    velocity = np.interp(s.t_s, quick.t_s, quick.velocity)
    noise = QUICK_COUNTS * trace.settings["resolution_rad"] / QUICK_S
    off = np.abs(velocity - s.velocity) > SLIP_SHARE * np.abs(s.velocity) + noise
    around = np.ones(2 * round(SLIP_AROUND_S / trace.period_s) + 1, dtype=bool)
    near: NDArray[np.bool_] = binary_dilation(off, around)
    return near


def strokes_of(s: Smooth) -> tuple[NDArray[np.int64], Array]:
    """Number of the stroke that each row belongs to, and the way since its reversal."""
    turned = np.flatnonzero(np.diff(np.sign(s.velocity)) != 0.0) + 1
    stroke = np.zeros(len(s.velocity), dtype=np.int64)
    stroke[turned] = 1
    stroke = np.cumsum(stroke)
    starts = np.concatenate([[0], turned])
    way: Array = np.abs(s.position - s.position[starts][stroke])
    return stroke, way


def _progress(stroke: NDArray[np.int64]) -> Array:
    """How far each row is through its stroke, 0 to 1, by time."""
    counts = np.bincount(stroke)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    progress: Array = (np.arange(len(stroke)) - starts[stroke]) / counts[stroke]
    return progress
