"""Frequency response of the sliding joint: inertia, viscous slope, delay, lag, first resonance, torque noise.

The multisine is the instrument: position and torque are both correlated with it, stroke by stroke, so that feedback,
quantisation and friction's own torque do not bias the response (joint input-output method; Pintelon and Schoukens,
System Identification, 2012, 2.7 and 7). The model is the exact sampled response of command, hold, delay and joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from servod.errors import AnswerIsNo
from servod.identify.estimate import Estimate, estimate, jackknife
from servod.identify.fits.rigid import Rigid, response_of
from servod.identify.trace import Trace

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Lines with less coherence than this carry no weight.
LEAST_COHERENCE = 0.6
#: Longest delay that is looked for, s.
LONGEST_DELAY_S = 0.05
#: The lag must lower the misfit this significantly before it counts as one.
LAG_SIGNIFICANCE = 1e-3
#: A resonance shows as a line this many dB above the rigid joint, clearly beyond its own uncertainty.
RESONANCE_DB = 3.0
#: Half widths that the scatter does not show: inertia by share, delay in s.
INERTIA_ALLOWANCE, DELAY_ALLOWANCE_S = 0.01, 3e-5


class ResponseFit(NamedTuple):
    """Estimates, and the response itself: lines in Hz, position over torque in rad/(N*m), its relative deviation."""

    inertia: Estimate
    viscous_slope: Estimate
    delay_s: Estimate
    lag_s: Estimate
    resonance_hz: Estimate | None
    torque_noise_rms: Estimate
    frequency_hz: Array
    response: Complex
    deviation: Array
    coherence: Array

    def rigid(self) -> Rigid:
        """The fitted rigid joint."""
        return Rigid(self.inertia.value, self.viscous_slope.value, self.delay_s.value, self.lag_s.value)


class _Stroke(NamedTuple):
    """Spectra of one stroke at the excited lines: velocity, torque, excitation."""

    velocity: Complex
    torque: Complex
    excitation: Complex


def fit(trace: Trace, inertia: float) -> ResponseFit:
    """Fit one multisine recording; `inertia` is the first idea of it. Raises AnswerIsNo without coherence."""
    frequency, strokes = _spectra(trace)
    coherence = _coherence(strokes)
    used = coherence >= LEAST_COHERENCE
    if np.count_nonzero(used) < 6:
        raise AnswerIsNo(
            "inertia and delay are not identifiable from this multisine: the motion is not coherent with it; allow "
            "more torque or speed, or a finer encoder"
        )
    deviation = _deviation(strokes)
    period = trace.period_s
    start = np.log([inertia, max(inertia * 10.0, 1e-12)])

    def solve(parts: Sequence[_Stroke], lag: bool) -> Array:
        return _solve(frequency[used], _ratio(parts)[used], deviation[used], period, start, lag)

    plain, with_lag = solve(strokes, False), solve(strokes, True)
    lag = _worse(frequency, strokes, deviation, used, period, plain, with_lag)
    values, spread = jackknife(lambda parts: solve(parts, lag), strokes)
    freedom = len(strokes) - 1
    response = _position_over_torque(frequency, _ratio(strokes), period)
    fitted = _position_over_torque(frequency, _model(frequency, values, period), period)
    return ResponseFit(
        estimate(values[0], spread[0], freedom, "kg*m^2", share=INERTIA_ALLOWANCE),
        estimate(values[1], spread[1], freedom, "N*m*s/rad", note="slope of the friction map at the sliding speed"),
        _delay(values, spread, freedom),
        _lag(values, spread, freedom, lag),
        _resonance(frequency, response, fitted, deviation),
        _torque_noise(strokes, trace, values),
        frequency,
        response,
        deviation,
        coherence,
    )


def _spectra(trace: Trace) -> tuple[Array, list[_Stroke]]:
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
        strokes.append(_Stroke(*(np.fft.rfft(part)[lines] / count for part in parts)))
    if len(strokes) < 4:
        raise AnswerIsNo("the multisine recording has fewer than four whole strokes")
    return lines / (count * trace.period_s), strokes


def _ratio(strokes: Sequence[_Stroke]) -> Complex:
    """Way per period over torque, through the excitation as instrument."""
    way = sum(s.velocity * s.excitation.conj() for s in strokes)
    torque = sum(s.torque * s.excitation.conj() for s in strokes)
    ratio: Complex = np.asarray(way / torque)
    return ratio


def _coherence(strokes: Sequence[_Stroke]) -> Array:
    """Share of the motion at each line that follows the excitation."""
    cross = np.abs(sum(s.velocity * s.excitation.conj() for s in strokes)) ** 2
    powers = sum(np.abs(s.velocity) ** 2 for s in strokes) * sum(np.abs(s.excitation) ** 2 for s in strokes)
    coherence: Array = np.asarray(cross / powers)
    return coherence


def _deviation(strokes: Sequence[_Stroke]) -> Array:
    """Relative standard deviation of the ratio at each line, smoothed over neighbours."""
    ratio = _ratio(strokes)
    misfit = np.array([np.abs(s.velocity - ratio * s.torque) ** 2 for s in strokes]).sum(axis=0)
    power = sum(np.abs(ratio * s.torque) ** 2 for s in strokes)
    relative = misfit / (len(strokes) - 1) / np.asarray(power)
    padded = np.pad(relative, 1, mode="edge")
    smooth = (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0
    deviation: Array = np.sqrt(smooth + 1e-6)
    return deviation


def _model(frequency: Array, values: Array, period_s: float) -> Complex:
    """Way per period over torque of the rigid joint with (inertia, viscous, delay, lag)."""
    rigid = Rigid(*(float(v) for v in values))
    return response_of(rigid, frequency, period_s)


def _solve(frequency: Array, ratio: Complex, deviation: Array, period: float, start: Array, lag: bool) -> Array:
    """(inertia, viscous, delay, lag) that fit the ratio; relative misfit, weighted."""

    def misfit(x: Array) -> Array:
        values = np.array([np.exp(x[0]), x[1] * np.exp(start[0]), x[2] * 1e-3, x[3] * 1e-3 if lag else 0.0])
        error = (_model(frequency, values, period) / ratio - 1.0) / deviation
        return np.concatenate([error.real, error.imag])

    best = None
    for delay in (0.5, 2.0, 5.0):
        first = np.array([start[0], 50.0, delay] + ([0.3] if lag else []))
        low = [start[0] - 3.0, -2000.0, 0.0] + ([0.0] if lag else [])
        high = [start[0] + 3.0, 1e5, 1e3 * LONGEST_DELAY_S] + ([50.0] if lag else [])
        found = least_squares(misfit, first, bounds=(low, high), loss="soft_l1", x_scale="jac")
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    x = best.x
    return np.array([np.exp(x[0]), x[1] * np.exp(start[0]), x[2] * 1e-3, x[3] * 1e-3 if lag else 0.0])


def _worse(
    frequency: Array, strokes: list[_Stroke], deviation: Array, used: NDArray[np.bool_], period: float,
    plain: Array, with_lag: Array,
) -> bool:  # fmt: skip
    """Whether the response without lag is significantly worse than with one (F test on one more parameter)."""
    ratio = _ratio(strokes)[used]
    costs = [
        float(np.sum(np.abs((_model(frequency[used], v, period) / ratio - 1.0) / deviation[used]) ** 2))
        for v in (plain, with_lag)
    ]
    freedom = 2 * len(ratio) - 4
    gain = (costs[0] - costs[1]) / max(costs[1] / freedom, 1.0 / len(strokes))
    return with_lag[3] > 1e-4 and float(stats.f.sf(gain, 1, freedom)) < LAG_SIGNIFICANCE


def _delay(values: Array, spread: Array, freedom: int) -> Estimate:
    note = "at the end of its range" if values[2] < 1e-6 or values[2] > 0.99 * LONGEST_DELAY_S else ""
    return estimate(values[2], spread[2], freedom, "s", floor=DELAY_ALLOWANCE_S, note=note)


def _lag(values: Array, spread: Array, freedom: int, lag: bool) -> Estimate:
    if lag:
        return estimate(values[3], spread[3], freedom, "s", floor=DELAY_ALLOWANCE_S)
    return Estimate(0.0, 0.0, 1e-4, "s", "none that could be told from the delay")


def _position_over_torque(frequency: Array, ratio: Complex, period_s: float) -> Complex:
    """From way per period to position at the sample."""
    z = np.exp(2j * np.pi * frequency * period_s)
    position: Complex = ratio / (z - 1.0)
    return position


def _resonance(frequency: Array, response: Complex, fitted: Complex, deviation: Array) -> Estimate | None:
    """The line that stands out most over the rigid joint, between its neighbours; None when none does."""
    excess = 20.0 * np.log10(np.abs(response / fitted))
    beyond = excess - 20.0 * np.log10(1.0 + 3.0 * deviation)
    top = int(np.argmax(beyond))
    if beyond[top] < RESONANCE_DB:
        return None
    low, high = frequency[max(top - 1, 0)], frequency[min(top + 1, len(frequency) - 1)]
    return Estimate(float(frequency[top]), float(low), float(high), "Hz", "resolution of the excited lines")


def _torque_noise(strokes: list[_Stroke], trace: Trace, values: Array) -> Estimate:
    """Torque disturbance in the lower half of the lines' band, from what the motion does beyond the torque."""
    frequency, _ = _spectra(trace)
    ratio = _model(frequency, values, trace.period_s)
    low = frequency < 40.0
    errors = np.array([np.abs((s.velocity - ratio * s.torque) / ratio)[low] for s in strokes])
    per_line = np.mean(2.0 * errors**2)
    bandwidth_lines = 40.0 * trace.settings["count"] * trace.period_s
    rms = float(np.sqrt(per_line * bandwidth_lines))
    return estimate(rms, 0.1 * rms, errors.size, "N*m", note="below 40 Hz while sliding, cogging included")
