"""All fits in order, from recordings alone: what the walk does at its end, and `servoctl identify --from` by itself.

Above the fits, below the walk; never touches an axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from servod.common.errors import AnswerIsNo
from servod.formats.model.identified import Devices
from servod.lab.identify.estimate import LEVEL, Estimate
from servod.lab.identify.fits import break_away, bristle, curve, friction_map, kick, presliding, response
from servod.lab.identify.fits.bristle import Bristle
from servod.lab.identify.trace import ExperimentKind, RecordedMotion

# --- Noise at rest ---------------------------------------------------------------------------------------------------
# Encoder and torque-reading noise from a recording at rest. A reading is rounded to counts. How much of its noise that
# hides or adds depends on where within a count the joint stands, which nobody knows: the interval of the encoder's
# noise spans every place.


Array = NDArray[np.float64]

#: Parts of the recording whose scatter makes the interval: neighbouring differences share a sample, and whatever colour
#: the noise has, tenths of a second do not.
PARTS = 15
#: So many events may be expected where none was seen (Poisson, one-sided at LEVEL).
UNSEEN_EVENTS = -math.log(1.0 - LEVEL)
#: Noise in counts up to which the place within a count matters; beyond, rounding adds its 1/12 everywhere.
WIDEST_COUNTS, ROUNDING = 1.5, 1.0 / 12.0
_GRID = np.linspace(1e-4, WIDEST_COUNTS, 301)


class NoiseFit(NamedTuple):
    """Standard deviations at rest: encoder in rad, torque reading in N*m."""

    encoder_rms: Estimate
    torque_reading_rms: Estimate


class _Variance(NamedTuple):
    """A variance with its 95 % interval."""

    value: float
    low: float
    high: float


def fit(trace: RecordedMotion) -> NoiseFit:
    """Noise of the differences between samples, so that slow drift does not count.

    The encoder's value is that of its readings, rounding included; its interval begins at the least that the noise
    alone can be, and holds both.
    """
    encoder = _encoder(_variance(trace.position_rad), len(trace), trace.settings["resolution_rad"])
    torque = _variance(trace.torque_actual_nm)
    note = "" if torque.value > 0.0 else "no reading changed: the noise is hidden below the drive's step"
    value, low, high = (math.sqrt(part) for part in torque)
    return NoiseFit(encoder, Estimate(value, low, high, "N*m", note))


def beside_rounding(low: float, high: float) -> tuple[float, float]:
    """Least and largest deviation of noise, in counts, whose rounded readings have a variance of `low` to `high`.

    Over every place within a count: midway between two, readings of next to no noise differ by a count already; in the
    middle of one, much of it shows nothing.
    """
    least = 0.0 if low <= _rounded_variance(0.5)[0] else _inverse(low, _rounded_variance(0.5))
    return least, _inverse(high, _rounded_variance(0.0))


def _encoder(seen: _Variance, samples: int, resolution_rad: float) -> Estimate:
    """RMS of the readings, and the interval that holds it and the noise beside rounding."""
    count = resolution_rad**2
    # few changes of the reading scatter too little to say how many there might have been
    most = max(seen.high, UNSEEN_EVENTS * count / samples)
    low, high = (resolution_rad * part for part in beside_rounding(seen.low / count, most / count))
    note = (
        f"rounding to counts of {resolution_rad:.2e} rad is in it; the noise beside it is {low:.2g} to {high:.2g} rad"
    )
    if seen.value == 0.0:
        note = f"no reading changed: the noise is hidden below one count, {resolution_rad:.2e} rad"
    elif seen.value > WIDEST_COUNTS**2 * count:
        note = ""
    return Estimate(math.sqrt(seen.value), low, max(high, math.sqrt(seen.high)), "rad", note)


def _variance(readings: Array) -> _Variance:
    """Half the mean square of the differences, interval by the scatter of parts."""
    squares = 0.5 * np.diff(readings) ** 2
    means = np.array([part.mean() for part in np.array_split(squares, PARTS)])
    half = float(stats.t.ppf(LEVEL, PARTS - 1) * means.std(ddof=1)) / math.sqrt(PARTS)
    value = float(squares.mean())
    return _Variance(value, max(0.0, value - half), value + half)


def _rounded_variance(offset: float) -> Array:
    """Variance of readings over `_GRID`, counts^2, of noise about a joint `offset` off the middle of a count."""
    counts = np.arange(-12, 13)
    edges = np.append(counts - 0.5, counts[-1] + 0.5) - offset
    shares = np.diff(stats.norm.cdf(edges[None, :] / _GRID[:, None]), axis=1)
    variance: Array = shares @ counts**2 - (shares @ counts) ** 2
    return variance


def _inverse(variance: float, over_grid: Array) -> float:
    """Deviation of the noise, in counts, whose readings have this variance."""
    if variance >= over_grid[-1]:
        return math.sqrt(variance - ROUNDING)
    return float(np.interp(variance, over_grid, _GRID))


#: Bristle damping against the critical one of inertia on the bristle, taken where it is not measured.
ASSUMED_DAMPING = 0.5
#: Torque noise lets a joint break away early by so many standard deviations.
EARLY_BY = 2.0


@dataclass(frozen=True)
class Analysis:
    """Every fit of one identification."""

    noise: NoiseFit
    break_away: break_away.BreakAwayFit
    presliding: presliding.PreslidingFit
    kick: kick.KickFit
    response: response.ResponseFit
    torque_noise: Estimate
    map: friction_map.MapFit
    positive: curve.CurveFit
    negative: curve.CurveFit
    damping: Estimate | None
    data_sha256: tuple[str, ...]  # of the recordings' files
    devices: Devices | None

    @property
    def break_away_rad(self) -> float:
        """Way of the bristles until the joint slides: static friction over stiffness."""
        return break_away_rad(self.break_away, self.presliding)


def break_away_rad(slides: break_away.BreakAwayFit, rocked: presliding.PreslidingFit) -> float:
    """Mean static friction over stiffness."""
    return 0.5 * (slides.positive.value + slides.negative.value) / rocked.stiffness.value


def of_kind(traces: Sequence[RecordedMotion], kind: ExperimentKind) -> list[RecordedMotion]:
    """The recordings of one experiment. Raises AnswerIsNo when there is none."""
    found = [trace for trace in traces if trace.kind == kind]
    if not found:
        raise AnswerIsNo(f"no recording of the experiment {kind.value}; run it first")
    return found


def analyse(traces: Sequence[RecordedMotion], devices: Devices | None = None) -> Analysis:
    """Fit everything that was recorded, with these devices.

    Raises AnswerIsNo where an experiment is missing or tells nothing.
    """
    ramps = of_kind(traces, ExperimentKind.BREAK_AWAY)
    slides = break_away.fit([ramp for ramp in ramps if not ramp.settings["search"]] or ramps)
    rocked = presliding.fit(of_kind(traces, ExperimentKind.PRESLIDING), slides)
    kicked = kick.fit(of_kind(traces, ExperimentKind.KICK))
    trace = of_kind(traces, ExperimentKind.RESPONSE)[-1]
    answer = response.fit(trace, kicked.inertia)
    delay_s = answer.delay_s.value + answer.lag_s.value
    damping = _damping(traces, answer, rocked)
    bristles = _bristle(slides, rocked, damping, answer.inertia.value)
    mapped = friction_map.fit(of_kind(traces, ExperimentKind.FRICTION_MAP), answer.inertia.value, delay_s, bristles)
    positive, negative = curve.fit(mapped.positive), curve.fit(mapped.negative)
    torque_noise = response.torque_noise(trace, answer, mapped.cogging)
    cogs = sum(wave.amplitude.value for wave in mapped.cogging)
    return Analysis(
        fit(of_kind(traces, ExperimentKind.NOISE)[-1]),
        break_away.widened(slides, math.hypot(cogs, EARLY_BY * torque_noise.value)),
        rocked,
        kicked,
        answer,
        torque_noise,
        mapped,
        positive,
        negative,
        damping,
        tuple(trace.sha256 for trace in traces if trace.sha256),
        devices,
    )


def assumed_damping(inertia: float, stiffness: float) -> float:
    """sigma1 where it is not measured: a share of the critical damping of inertia on the bristle."""
    return ASSUMED_DAMPING * 2.0 * math.sqrt(stiffness * inertia)


def _damping(
    traces: Sequence[RecordedMotion], answer: response.ResponseFit, rocked: presliding.PreslidingFit
) -> Estimate | None:
    """Bristle damping from the newest recording that shows it; None when there is none or it does not tell."""
    ringing = [trace for trace in traces if trace.kind == ExperimentKind.BRISTLE]
    if not ringing or answer.lag_s.value > 0.0:
        return None
    viscous = max(0.0, answer.viscous_slope.value)
    moved = bristle.Moved(answer.inertia.value, answer.resonance.joint if answer.resonance else None)
    return bristle.fit(ringing[-1], moved, answer.delay_s.value, viscous, rocked.stiffness.value)


def _bristle(
    slides: break_away.BreakAwayFit, rocked: presliding.PreslidingFit, damping: Estimate | None, inertia: float
) -> Bristle:
    """What the map must know of the bristles."""
    stiffness = rocked.stiffness.value
    measured = damping.value if damping is not None else assumed_damping(inertia, stiffness)
    return Bristle(stiffness, measured, 0.5 * (slides.positive.value + slides.negative.value))
