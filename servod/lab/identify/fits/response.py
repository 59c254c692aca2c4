"""Frequency response of the sliding joint: inertia, viscous slope, delay, lag, first resonance; and the torque noise.

The multisine is the instrument: position and torque are both correlated with it, stroke by stroke, so that feedback,
quantisation and friction's own torque do not bias the response (joint input-output method; Pintelon and Schoukens,
System Identification, 2012, 2.7 and 7). The model is the exact sampled response of command, hold, delay and joint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from servod.common.errors import AnswerIsNo
from servod.lab.identify.estimate import LEVEL, Estimate, bound_notes, estimate, jackknife, joined
from servod.lab.identify.fits import elastic
from servod.lab.identify.fits.friction_map import FittedHarmonic
from servod.lab.identify.trace import RecordedMotion

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Lines with less coherence than this carry no weight.
LEAST_COHERENCE = 0.6
#: Longest delay and lag that are looked for, s.
LONGEST_DELAY_S = LONGEST_LAG_S = elastic.LONGEST_DELAY_S
#: The lag must lower the misfit this significantly before it counts as one.
LAG_SIGNIFICANCE = 1e-3
#: A rigid joint that leaves this misfit per line is not all; two masses must leave at most this share of it.
UNEXPLAINED, SPRUNG_COST = 1.5, 0.2
#: Half widths that the scatter does not show: inertia by share, delay in s. The same joint started ten milliseconds
#: later is told a delay that differs by 25 us.
INERTIA_ALLOWANCE, DELAY_ALLOWANCE_S = 0.01, 5e-5
#: A lag of up to this is never told, and what is said of one that was not.
LEAST_UNSEEN_S = 1e-4
NO_LAG = "none that could be told from the delay; what there is, is part of the delay"
#: Torque noise is told up to here: above, the encoder's own shows more.
NOISE_HZ = 40.0
#: Variance of the second difference of independent values of variance one: 1 + 4 + 1.
SECOND_DIFFERENCE = 6.0


class Resonance(NamedTuple):
    """A first resonance: of both masses against each other, and the inertia behind the spring."""

    frequency_hz: Estimate
    load_inertia: Estimate
    joint: elastic.Elastic


class ResponseFit(NamedTuple):
    """Estimates, and the response itself.

    At the lines `frequency_hz`: position over torque in rad/(N*m), the relative standard deviation of its mean over the
    strokes, and the coherence of motion and excitation.
    """

    inertia: Estimate
    viscous_slope: Estimate
    delay_s: Estimate
    lag_s: Estimate
    resonance: Resonance | None
    frequency_hz: Array
    response: Complex
    deviation: Array
    coherence: Array
    period_s: float

    @property
    def used(self) -> NDArray[np.bool_]:
        """Lines that the estimates rest on."""
        return self.coherence >= LEAST_COHERENCE

    def model(self, frequency_hz: Array) -> Complex:
        """Position over torque of what was fitted, rad/(N*m)."""
        return position_over_torque(frequency_hz, self.way_model(frequency_hz), self.period_s)

    def way_model(self, frequency_hz: Array) -> Complex:
        """Way per period over torque of what was fitted, rad/(N*m)."""
        if self.resonance is not None:
            return elastic.response_of(self.resonance.joint, frequency_hz, self.period_s)
        rigid = Rigid(self.inertia.value, self.viscous_slope.value, self.delay_s.value, self.lag_s.value)
        return response_of(rigid, frequency_hz, self.period_s)

    def phase_rad(self, of: Complex) -> Array:
        """Phase of a response at the lines, each on the turn that is nearest to the fitted one.

        The lowest lines, which cogging disturbs, do not tell by themselves how it goes from one to the next.
        """
        fitted = self.model(self.frequency_hz)
        phase: Array = falling_phase_rad(fitted) + np.angle(of / fitted)
        return phase


def falling_phase_rad(response: Complex) -> Array:
    """Phase of a smooth response from torque to position, which begins below zero and goes on without turns."""
    phase = np.unwrap(np.angle(response))
    falling: Array = phase - 2.0 * np.pi if phase[0] > 0.0 else phase
    return falling


class _Lines(NamedTuple):
    """What the models are fitted to: lines in Hz, relative deviation of the strokes' mean at each, period in s."""

    frequency: Array
    deviation: Array
    period_s: float


class _Found(NamedTuple):
    """The chosen model: inertia, viscous, delay, lag; its deviations and notes; the spring, where there is one."""

    values: Array
    spread: Array
    notes: Sequence[str]
    lag: Estimate
    resonance: Resonance | None


def fit(trace: RecordedMotion, inertia: float) -> ResponseFit:
    """Fit one multisine recording; `inertia` is the first idea of it. Raises AnswerIsNo without coherence."""
    frequency, strokes = spectra(trace)
    coherence = coherence_of(strokes)
    used = coherence >= LEAST_COHERENCE
    if np.count_nonzero(used) < 6:
        raise AnswerIsNo(
            "inertia and delay are not identifiable from this multisine: the motion is not coherent with it; allow "
            "more torque or speed, or a finer encoder"
        )
    deviation, period = deviation_of(strokes), trace.period_s
    seen = [StrokeSpectra(s.velocity[used], s.torque[used], s.excitation[used]) for s in strokes]
    found = _choose(_Lines(frequency[used], deviation[used], period), seen, inertia)
    values, spread, notes, freedom = found.values, found.spread, found.notes, len(strokes) - 1
    slope = joined("slope of the friction map at the sliding speed", notes[1])
    return ResponseFit(
        estimate(values[0], spread[0], freedom, "kg*m^2", share=INERTIA_ALLOWANCE, note=notes[0]),
        estimate(values[1], spread[1], freedom, "N*m*s/rad", note=slope),
        _delay(values[2], spread[2], freedom, notes[2], found.lag),
        found.lag,
        found.resonance,
        frequency,
        position_over_torque(frequency, ratio_of(strokes), period),
        deviation,
        coherence,
        period,
    )


def _choose(lines: _Lines, strokes: Sequence[StrokeSpectra], inertia: float) -> _Found:
    """The simplest model that explains the response: rigid, rigid behind a lag, two masses."""
    start = np.log([inertia, max(inertia * 10.0, 1e-12)])

    def solve(parts: Sequence[StrokeSpectra], lag: bool) -> Array:
        return _solve(lines.frequency, ratio_of(parts), lines.deviation, lines.period_s, start, lag)

    ratio = ratio_of(strokes)
    plain, with_lag = solve(strokes, False), solve(strokes, True)
    costs = [_cost(lines, ratio, values) for values in (plain, with_lag)]
    if sprung := _sprung(lines, strokes, inertia, (plain, with_lag)):
        return sprung
    lagged, lag_spread = jackknife(lambda parts: solve(parts, True), strokes)
    freedom = len(strokes) - 1
    if _worse(costs, lines, len(strokes), with_lag):
        notes = _notes(lagged, start)
        lag = estimate(lagged[3], lag_spread[3], freedom, "s", floor=DELAY_ALLOWANCE_S, note=notes[3])
        return _Found(lagged, lag_spread, notes, lag, None)
    unseen = lagged[3] + float(stats.t.ppf(LEVEL, freedom)) * lag_spread[3]
    lag = Estimate(0.0, 0.0, min(max(LEAST_UNSEEN_S, unseen), float(plain[2])), "s", NO_LAG)
    values, spread = jackknife(lambda parts: solve(parts, False), strokes)
    return _Found(values, spread, _notes(values, start), lag, None)


def _sprung(lines: _Lines, strokes: Sequence[StrokeSpectra], inertia: float, rigid: Sequence[Array]) -> _Found | None:
    """Two masses with a spring, if they explain what the `rigid` joints leave, beyond where cogging disturbs.

    A slow cycle has few lines there, or none: fewer numbers than two masses have tell nothing of them.
    """
    upper, ratio = lines.frequency >= elastic.LOWEST_HZ, ratio_of(strokes)
    seen = _Lines(lines.frequency[upper], lines.deviation[upper], lines.period_s)
    rigid_cost = min(_cost(seen, ratio[upper], values) for values in rigid)
    count = int(np.count_nonzero(upper))
    if 2 * count <= len(elastic.Elastic._fields) or rigid_cost < UNEXPLAINED * count:
        return None
    joint = elastic.solve(lines.frequency, ratio, lines.deviation, lines.period_s, inertia)
    error = elastic.response_of(joint, seen.frequency, seen.period_s) / ratio[upper] - 1.0
    if float(np.sum(np.abs(error / seen.deviation) ** 2)) > SPRUNG_COST * rigid_cost:
        return None

    def solve(parts: Sequence[StrokeSpectra]) -> Array:
        return np.array(elastic.solve_from(joint, lines.frequency, ratio_of(parts), lines.deviation, lines.period_s))

    values, spread = jackknife(solve, strokes)
    freedom, notes = len(strokes) - 1, elastic.notes(elastic.Elastic(*values), inertia, float(lines.frequency[-1]))
    damping = f"its damping {notes.damping_ratio}" if notes.damping_ratio else ""
    load_spread = float(np.hypot(spread[4] * values[0], spread[0] * values[4]))
    resonance = Resonance(
        estimate(
            values[3], spread[3], freedom, "Hz", share=2.0 * INERTIA_ALLOWANCE, note=joined(notes.resonance_hz, damping)
        ),
        estimate(
            values[4] * values[0], load_spread, freedom, "kg*m^2", share=3.0 * INERTIA_ALLOWANCE, note=notes.load_share
        ),
        elastic.Elastic(*values),
    )
    rows = 2 * len(lines.frequency) - len(joint)
    worse = 1.0 + float(stats.f.ppf(2.0 * LEVEL - 1.0, 1, rows)) / rows
    longest = min(lines.period_s, float(values[2]))
    unseen = elastic.longest_lag_s(joint, lines.frequency, ratio, lines.deviation, lines.period_s, longest, worse)
    lag = Estimate(0.0, 0.0, max(min(LEAST_UNSEEN_S, longest), unseen), "s", NO_LAG)
    return _Found(np.array([*values[:3], 0.0]), np.array([*spread[:3], 0.0]), notes[:3], lag, resonance)


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
        bounds = [bound[: len(first)] for bound in _ranges(start)]
        found = least_squares(misfit, first, bounds=bounds, loss="soft_l1", x_scale="jac")
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    x = best.x
    return np.array([np.exp(x[0]), x[1] * np.exp(start[0]), x[2] * 1e-3, x[3] * 1e-3 if lag else 0.0])


def _ranges(start: Array) -> tuple[list[float], list[float]]:
    """Bounds of log inertia, viscous slope over inertia's first idea in 1/s, delay and lag in ms."""
    low = [start[0] - 3.0, -2000.0, 0.0, 0.0]
    return low, [start[0] + 3.0, 1e5, 1e3 * LONGEST_DELAY_S, 1e3 * LONGEST_LAG_S]


def _notes(values: Array, start: Array) -> tuple[str, ...]:
    """What of (inertia, viscous, delay, lag) stands at the end of its range."""
    inertia, viscous, delay_s, lag_s = values.tolist()
    return bound_notes([np.log(inertia), viscous / np.exp(start[0]), 1e3 * delay_s, 1e3 * lag_s], *_ranges(start))


def _cost(lines: _Lines, ratio: Complex, values: Array) -> float:
    """Misfit of the rigid joint: sum of squares, relative to the deviation of the strokes' mean."""
    error = (_model(lines.frequency, values, lines.period_s) / ratio - 1.0) / lines.deviation
    return float(np.sum(np.abs(error) ** 2))


def _worse(costs: Sequence[float], lines: _Lines, strokes: int, with_lag: Array) -> bool:
    """Whether the response without lag is significantly worse than with one (F test on one more parameter)."""
    freedom = 2 * len(lines.frequency) - 4
    gain = (costs[0] - costs[1]) / max(costs[1] / freedom, 1.0 / strokes)
    return with_lag[3] > LEAST_UNSEEN_S and float(stats.f.sf(gain, 1, freedom)) < LAG_SIGNIFICANCE


def _delay(value_s: float, spread_s: float, freedom: int, note: str, lag: Estimate) -> Estimate:
    """The delay; where a lag could not be told from it, it may be shorter by that."""
    found = estimate(value_s, spread_s, freedom, "s", floor=DELAY_ALLOWANCE_S, note=note)
    return found if lag.value > 0.0 else replace(found, low=found.low - lag.high)


def torque_noise(trace: RecordedMotion, answer: ResponseFit, cogging: Sequence[FittedHarmonic]) -> Estimate:
    """Torque disturbance below `NOISE_HZ` beside `cogging`: what the motion does beyond the torque.

    Its interval is the scatter of the strokes; all lines count. Differences of neighbours keep out that a stroke does
    not end as it began, which adds the same to all lines (Pintelon and Schoukens, 2012, 2.2.3).
    """
    known = replace(trace, torque_nm=trace.torque_nm - _in_commands(cogging, trace, answer))
    stroke_s, excited = trace.settings["count"] * answer.period_s, excited_lines(trace)
    last = min(math.ceil(NOISE_HZ * stroke_s), int(excited[-1]))
    lines = np.arange(max(1, min(int(excited[0]) - 1, last - 3)), last + 1)
    frequency = lines / stroke_s
    ratio = answer.way_model(frequency)
    strokes = strokes_of(known, lines)

    def rms(parts: Sequence[StrokeSpectra]) -> Array:
        errors = np.abs(np.diff([s.velocity / ratio - s.torque for s in parts], 2))
        return np.array([math.sqrt(float(np.mean(2.0 * errors**2)) / SECOND_DIFFERENCE * last)])

    found, spread = jackknife(rms, strokes)
    note = f"below {last / stroke_s:g} Hz while sliding, beside the cogging that is known"
    return estimate(found[0], spread[0], len(strokes) - 1, "N*m", share=INERTIA_ALLOWANCE, note=note)


def _in_commands(cogging: Sequence[FittedHarmonic], trace: RecordedMotion, answer: ResponseFit) -> Array:
    """Resisting torque of `cogging` as commands: each acts on a joint that is by delay and half a hold further."""
    late_s = answer.delay_s.value + answer.lag_s.value + 0.5 * answer.period_s
    position = np.interp(trace.t_s + late_s, trace.t_s, trace.position_rad)
    torque: Array = np.zeros(len(position))
    for wave in cogging:
        torque += wave.amplitude.value * np.sin(wave.order * position + wave.phase)
    return torque


# --- Strokes ---------------------------------------------------------------------------------------------------------
# Spectra of a multisine recording, stroke by stroke: response, coherence and scatter at the excited lines.


class StrokeSpectra(NamedTuple):
    """Spectra of one stroke: velocity, torque, excitation."""

    velocity: Complex
    torque: Complex
    excitation: Complex


def spectra(trace: RecordedMotion) -> tuple[Array, list[StrokeSpectra]]:
    """Excited lines in Hz and the spectra of every whole stroke there. Raises AnswerIsNo with too few strokes."""
    lines = excited_lines(trace)
    strokes = strokes_of(trace, lines)
    if len(strokes) < 4:
        raise AnswerIsNo(
            f"the multisine recording has {len(strokes)} whole strokes, and four are needed: see that nothing stops "
            "the axis on its way, or give it more --travel"
        )
    return lines / (trace.settings["count"] * trace.period_s), strokes


def excited_lines(trace: RecordedMotion) -> NDArray[np.int_]:
    """Numbers of the multisine's lines, in periods of a stroke, ascending."""
    s = trace.settings
    return np.array([int(s[f"line_{i}"]) for i in range(sum(key.startswith("line_") for key in s))])


def strokes_of(trace: RecordedMotion, lines: NDArray[np.int_]) -> list[StrokeSpectra]:
    """Spectra of every whole stroke at these lines."""
    s = trace.settings
    count, first, stride = int(s["count"]), int(s["first"]), int(s["stride"])
    strokes = []
    for i in range(int(s["strokes"])):
        start = first + i * stride
        if start + count >= len(trace):
            break
        way = np.diff(trace.position_rad[start : start + count + 1])
        parts = (way - way.mean(), trace.torque_nm[start : start + count], trace.excitation_nm[start : start + count])
        strokes.append(StrokeSpectra(*(np.fft.rfft(part)[lines] / count for part in parts)))
    return strokes


def ratio_of(strokes: Sequence[StrokeSpectra]) -> Complex:
    """Way per period over torque, through the excitation as instrument."""
    way = sum(s.velocity * s.excitation.conj() for s in strokes)
    torque = sum(s.torque * s.excitation.conj() for s in strokes)
    ratio: Complex = np.asarray(way / torque)
    return ratio


def coherence_of(strokes: Sequence[StrokeSpectra]) -> Array:
    """Share of the motion at each line that follows the excitation."""
    cross = np.abs(sum(s.velocity * s.excitation.conj() for s in strokes)) ** 2
    powers = sum(np.abs(s.velocity) ** 2 for s in strokes) * sum(np.abs(s.excitation) ** 2 for s in strokes)
    coherence: Array = np.asarray(cross / powers)
    return coherence


def deviation_of(strokes: Sequence[StrokeSpectra]) -> Array:
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
