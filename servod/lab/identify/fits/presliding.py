"""Bristle stiffness c0 from presliding bursts: the Dahl curve's slope at zero (the paper's Fig. 7).

The fundamental of displacement under the fundamental of torque, after drift is taken off. At an amplitude that is not
small against break-away the curve is bent; Dahl's closed solution between two reversals says by how much, so that the
slope at zero comes out, not the chord.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.lab.identify.estimate import Estimate, estimate, jackknife
from servod.lab.identify.fits.break_away import BreakAwayFit
from servod.lab.identify.trace import RecordedMotion

Array = NDArray[np.float64]

#: Steps of the hysteresis loop's integration.
_LOOP_STEPS = 2000

#: Share of c0 for what the scatter of bursts does not show: break-away's own error in the bend, bristle damping.
ALLOWANCE = 0.02

#: Share of a count that may be left of the encoder's steps in the displacement from peak to peak.
STEP_SHARE = 0.1

#: Wider than this share of its value, the stiffness counts as not identified; where the encoder is why, a displacement
#: of so many counts from peak to peak would tell it. (Two would do; of less than one, the steps show up to twice as
#: much as there is.)
WIDEST_SHARE, ENOUGH_COUNTS = 0.3, 4.0
#: What bursts that hardly ever pass an encoder step show of their displacement, in counts, is no less than this.
LEAST_COUNTS = 0.1


class PreslidingFit(NamedTuple):
    """Stiffness c0 in N*m/rad, and the averaged curve: torque over displacement, one cycle."""

    stiffness: Estimate
    bend: float
    displacement_rad: Array
    torque_nm: Array


def fundamental(values: Array, frequency_hz: float, period_s: float) -> complex:
    """Complex amplitude at `frequency_hz`, constant and trend fitted beside it."""
    t = np.arange(len(values)) * period_s
    w = 2.0 * np.pi * frequency_hz
    columns = np.column_stack([np.cos(w * t), np.sin(w * t), np.ones_like(t), t - t.mean()])
    cosine, sine = np.linalg.lstsq(columns, values, rcond=None)[0][:2]
    return complex(cosine, -sine)


def bend_factor(amplitude_nm: float, positive_nm: float, negative_nm: float) -> float:
    """|fundamental of c0*x| over |fundamental of torque| on a steady Dahl loop under a torque sine.

    Dahl: c0*dx = dF/(1 - F/g) while sliding forward, dF/(1 + F/g) backward, with g of that direction.
    """
    phase = 2.0 * np.pi * (np.arange(_LOOP_STEPS) + 0.5) / _LOOP_STEPS
    torque, rate = amplitude_nm * np.sin(phase), np.cos(phase)
    forward = np.clip(1.0 - torque / positive_nm, 0.02, None)
    backward = np.clip(1.0 + torque / negative_nm, 0.02, None)
    slope = 1.0 / np.where(rate > 0.0, forward, backward)
    step = amplitude_nm * rate * slope * (2.0 * np.pi / _LOOP_STEPS)
    way = np.cumsum(step)
    way -= (np.arange(_LOOP_STEPS) + 1.0) / _LOOP_STEPS * way[-1]  # the loop creeps; only what repeats counts
    return float(abs(np.mean(way * np.exp(-1j * phase))) / abs(np.mean(torque * np.exp(-1j * phase))))


def fit(bursts: Sequence[RecordedMotion], break_away: BreakAwayFit) -> PreslidingFit:
    """c0 over all bursts that stayed below break-away.

    Raises AnswerIsNo when none did, or when the encoder shows too little of them.
    """
    used = [b for b in bursts if len(_steady(b)) > 1]
    widest = max((b.settings["share"] for b in used), default=0.0)
    used = [b for b in used if b.settings["share"] == widest]
    if not used:
        raise AnswerIsNo("no presliding burst stayed below break-away; identify with a smaller share of it")
    responses = [_response(b) for b in used]
    amplitude = float(np.mean([abs(u) for u, _ in responses]))
    bend = bend_factor(amplitude, break_away.positive.value, break_away.negative.value)
    resolution_rad, way_rad = used[0].settings["resolution_rad"], 2.0 * abs(sum(x for _, x in responses)) / len(used)
    if way_rad == 0.0:
        raise _too_coarse(resolution_rad, way_rad)
    steps = STEP_SHARE * resolution_rad / way_rad  # a few bursts do not average them out entirely
    unseen = math.hypot(ALLOWANCE, _sensitivity(amplitude, break_away, bend), steps)

    def stiffness(parts: Sequence[tuple[complex, complex]]) -> Array:
        torque, way = sum(u for u, _ in parts), sum(x for _, x in parts)
        return np.array([bend * abs(torque / way)]) if abs(way) > 0.0 else np.array([math.inf])

    value, deviation = jackknife(stiffness, responses)
    result = estimate(float(value[0]), float(deviation[0]), len(used) - 1, "N*m/rad", share=unseen)
    if not result.half_width <= WIDEST_SHARE * result.value:
        raise _too_coarse(resolution_rad, way_rad)
    return PreslidingFit(result, bend, *_curve(used))


def _too_coarse(resolution_rad: float, way_rad: float) -> AnswerIsNo:
    """What to say where the displacement below break-away is lost in steps or noise of the encoder."""
    counts = max(way_rad / resolution_rad, LEAST_COUNTS)
    wanted = 2.0 * math.pi / resolution_rad * ENOUGH_COUNTS / counts
    remedy = "quieten what shakes the joint or its reading"
    if counts < ENOUGH_COUNTS:
        remedy = f"fit an encoder of {wanted:.2g} counts per turn or more"
    return AnswerIsNo(
        "the bristles' stiffness is not identifiable with this encoder: below break-away the joint moves by some "
        f"{counts:.1g} counts of {1e6 * resolution_rad:.3g} urad; {remedy}"
    )


def _sensitivity(amplitude: float, break_away: BreakAwayFit, bend: float) -> float:
    """Relative half width that break-away's interval puts on the bend."""
    widened = bend_factor(amplitude, break_away.positive.low, break_away.negative.low)
    return abs(widened / bend - 1.0)


def _steady(burst: RecordedMotion) -> NDArray[np.int64]:
    """Indices of the whole cycles behind the fade-in; empty when the burst was cut short."""
    first = round(burst.settings["from_s"] / burst.period_s)
    whole = round(burst.settings["cycles"] / burst.settings["frequency_hz"] / burst.period_s)
    end = first + whole - 1
    return np.arange(first, end, dtype=np.int64) if len(burst) >= end else np.arange(0, dtype=np.int64)


def _response(burst: RecordedMotion) -> tuple[complex, complex]:
    """Fundamentals of torque and displacement, both turned so that the torque's is real."""
    rows, f, period = _steady(burst), burst.settings["frequency_hz"], burst.period_s
    torque = fundamental(burst.torque_nm[rows], f, period)
    turn = abs(torque) / torque
    return complex(abs(torque)), fundamental(burst.position_rad[rows], f, period) * turn


def _curve(bursts: Sequence[RecordedMotion]) -> tuple[Array, Array]:
    """One averaged cycle of displacement and torque over all bursts."""
    cycles = []
    for burst in bursts:
        rows, f, period = _steady(burst), burst.settings["frequency_hz"], burst.period_s
        length, way = round(1.0 / f / period), burst.position_rad[rows]
        way = way - np.polyval(np.polyfit(rows, way, 1), rows)
        for i in range(len(rows) // length):
            cut = slice(i * length, (i + 1) * length)
            cycles.append(np.array([way[cut], burst.torque_nm[rows][cut]]))
    mean: Array = np.mean(cycles, axis=0)
    return mean[0], mean[1]
