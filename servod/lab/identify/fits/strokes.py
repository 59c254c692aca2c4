"""Spectra of a multisine recording, stroke by stroke: response, coherence and scatter at the excited lines.

Under the response fit, which puts a model to them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.lab.identify.trace import RecordedMotion

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Stroke(NamedTuple):
    """Spectra of one stroke at the excited lines: velocity, torque, excitation."""

    velocity: Complex
    torque: Complex
    excitation: Complex


def spectra(trace: RecordedMotion) -> tuple[Array, list[Stroke]]:
    """Lines in Hz and the spectra of every whole stroke."""
    s = trace.settings
    count, first, stride = int(s["count"]), int(s["first"]), int(s["stride"])
    lines = np.array([int(s[f"line_{i}"]) for i in range(sum(key.startswith("line_") for key in s))])
    strokes = []
    for i in range(int(s["strokes"])):
        start = first + i * stride
        if start + count >= len(trace):
            break
        way = np.diff(trace.position_rad[start : start + count + 1])
        parts = (way - way.mean(), trace.torque_nm[start : start + count], trace.excitation_nm[start : start + count])
        strokes.append(Stroke(*(np.fft.rfft(part)[lines] / count for part in parts)))
    if len(strokes) < 4:
        raise AnswerIsNo(
            f"the multisine recording has {len(strokes)} whole strokes, and four are needed: see that nothing stops "
            "the axis on its way, or give it more --travel"
        )
    return lines / (count * trace.period_s), strokes


def ratio_of(strokes: Sequence[Stroke]) -> Complex:
    """Way per period over torque, through the excitation as instrument."""
    way = sum(s.velocity * s.excitation.conj() for s in strokes)
    torque = sum(s.torque * s.excitation.conj() for s in strokes)
    ratio: Complex = np.asarray(way / torque)
    return ratio


def coherence_of(strokes: Sequence[Stroke]) -> Array:
    """Share of the motion at each line that follows the excitation."""
    cross = np.abs(sum(s.velocity * s.excitation.conj() for s in strokes)) ** 2
    powers = sum(np.abs(s.velocity) ** 2 for s in strokes) * sum(np.abs(s.excitation) ** 2 for s in strokes)
    coherence: Array = np.asarray(cross / powers)
    return coherence


def deviation_of(strokes: Sequence[Stroke]) -> Array:
    """Relative standard deviation of the strokes' common ratio at each line, smoothed over neighbours."""
    ratio = ratio_of(strokes)
    misfit = np.array([np.abs(s.velocity - ratio * s.torque) ** 2 for s in strokes]).sum(axis=0)
    power = sum(np.abs(ratio * s.torque) ** 2 for s in strokes)
    relative = misfit / (len(strokes) - 1) / np.asarray(power)
    padded = np.pad(relative, 1, mode="edge")
    smooth = (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0
    deviation: Array = np.sqrt(smooth + 1e-6)
    return deviation


def position_over_torque(frequency: Array, ratio: Complex, period_s: float) -> Complex:
    """From way per period to position at the sample."""
    z = np.exp(2j * np.pi * frequency * period_s)
    position: Complex = ratio / (z - 1.0)
    return position


# --- Response of a rigid joint ---------------------------------------------------------------------------------------
# Sampled frequency response of a rigid joint behind command, hold, delay and first-order lag; exact, in closed form.


class Rigid(NamedTuple):
    """m*dv/dt = T - d*v, dT/dt = (u(t - delay) - T)/lag: kg*m^2, N*m*s/rad, s, s."""

    inertia: float
    viscous: float
    delay_s: float
    lag_s: float


def response_of(joint: Rigid, frequency_hz: Array, period_s: float) -> Complex:
    """Way travelled in a period, x(k+1) - x(k), over the command of sample k, at each frequency.

    A command held over a period and delayed by a whole number of periods and a part is two steps; position answers a
    step of torque by ramp and exponentials (partial fractions of 1/(s^2 (m s + d)(lag s + 1))).
    """
    z = np.exp(2j * np.pi * frequency_hz * period_s)
    whole = math.floor(joint.delay_s / period_s)
    part = joint.delay_s / period_s - whole
    # x(t) after a torque step at 0, sampled at (n - part)*T, as a z-transform of its first difference
    lead = (1.0 - part) * period_s
    total = np.zeros(len(z), dtype=np.complex128)
    for weight, pole in _modes(joint):
        total += weight * _sampled_exponential(pole, lead, period_s, z)
    total += _sampled_ramp(joint, lead, period_s, z)
    # step -> held pulse: (1 - 1/z); position -> way per period: (z - 1)
    response: Complex = total * (1.0 - 1.0 / z) * (z - 1.0) * z ** (-whole)
    return response


def _modes(joint: Rigid) -> list[tuple[float, float]]:
    """(weight, pole) of the exponentials in the step response of position."""
    a = _slow_pole(joint)
    if joint.lag_s < 1e-6:
        return [(1.0 / (joint.inertia * a * a), -a)]
    b = 1.0 / joint.lag_s
    gain = b / joint.inertia

    return [(gain / (a * a * (b - a)), -a), (gain / (b * b * (a - b)), -b)]


def _slow_pole(joint: Rigid) -> float:
    """d/m, kept away from zero and from the lag's pole, where the partial fractions would divide by nothing."""
    a = joint.viscous / joint.inertia
    if abs(a) < 1e-3:
        a = 1e-3
    if joint.lag_s >= 1e-6 and abs(a * joint.lag_s - 1.0) < 1e-4:
        a *= 1.001
    return a


def _sampled_ramp(joint: Rigid, lead: float, period: float, z: Complex) -> Complex:
    """z-transform of the ramp and constant of the step response, first sample `lead` after the step."""
    a = _slow_pole(joint)
    slope = 1.0 / (joint.inertia * a)
    lag = joint.lag_s if joint.lag_s >= 1e-6 else 0.0
    offset = -slope * (1.0 / a + lag)
    step = 1.0 / (z - 1.0)  # samples 1, 2, ... of a unit step
    ramp = lead / (z - 1.0) + period / (z - 1.0) ** 2
    sampled: Complex = slope * ramp + offset * step
    return sampled


def _sampled_exponential(pole: float, lead: float, period: float, z: Complex) -> Complex:
    """z-transform of exp(pole*t) at lead, lead + T, ... as samples 1, 2, ..."""
    sampled: Complex = np.exp(pole * lead) / (z - np.exp(pole * period))
    return sampled
