"""What is told about a run: tracking error, roughness of the torque, and how a step settles and is held.

Behind the recorder and the simulator alike: plain arrays in, plain numbers out, so that a measured and a simulated run
are judged by the same rules. Needs numpy (the lab part).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.kernels.motions import paper
from servod.kernels.scoring import SETTLE_S, settling_band
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import ClosedLoopRun, LoopSettings, simulate_closed_loop

Array = NDArray[np.float64]

#: What is held is judged from here after the step on, whether or not it has settled.
HOLD_FROM_S = 1.0
#: The steady error is the mean of the last part of the hold.
STEADY_S = 1.0
#: Fast oscillation: a line of the spectrum, from LINE_FROM_HZ on, whose amplitude is more counts than this. Noise of a
#: count is spread over all lines and shows a tenth of it in each.
LINE_COUNTS = 1.0
LINE_FROM_HZ = 5.0
SEGMENT_S = 1.0
#: Slow hunting: the mean position of every SMOOTH_S turns and comes back by more counts than this ...
SWING_COUNTS = 2.5
SMOOTH_S = 0.05
#: ... so many times while it is held: two whole periods. Creep goes one way.
SWINGS = 4
#: Fast motion without a line: readings scatter from cycle to cycle by more than this factor on what is known of the
#: encoder. A joint that stands between two counts scatters by the root of three on rounding alone.
SCATTER = 2.0
#: What counts as a count where the encoder has no steps, or finer ones [rad].
LEAST_COUNT_RAD = 4e-6
ROUNDING = math.sqrt(12.0)  # a count over the RMS of rounding to it


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """One motion for a picture: time since it began in s, positions in rad, torques in N*m; equal lengths.

    `position_rad` is what the encoder showed. The torque is the sum of its three parts, after the limits.
    """

    time_s: Array
    reference_rad: Array
    position_rad: Array
    torque_nm: Array
    feedback_nm: Array
    friction_nm: Array
    other_nm: Array

    @property
    def error_mrad(self) -> Array:
        """Reference minus position."""
        return (self.reference_rad - self.position_rad) * 1e3


class HoldOf(StrEnum):
    """Whose swing `hold_mrad` is: the joint's own, which only a virtual world knows, or that of its readings."""

    JOINT = "joint"
    ENCODER = "encoder"


@dataclass(frozen=True, slots=True)
class StepResponse:
    """One step and its hold. `settling_s` is None when the error does not come to stay within the band.

    `overshoot` is a share of the step, `steady_error_mrad` the mean error at the end of the hold, without sign.
    `hold_mrad` is peak to peak of the position from HOLD_FROM_S on: `hold_of` the joint itself in a virtual world, and
    on any other axis, as `hold_encoder_mrad`, of what the encoder shows. In that is the encoder's noise:
    `hold_noise_mrad` is what rounding, and the noise that is known of the encoder, show of a joint that stands.
    """

    settling_s: float | None
    overshoot: float
    steady_error_mrad: float
    hold_mrad: float
    hold_of: HoldOf
    hold_encoder_mrad: float
    hold_noise_mrad: float
    limit_cycle: bool

    def document(self) -> dict[str, Any]:
        """Plain values, as JSON has them."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Score:
    """How well a run followed: position error of the encoder against the reference, in mrad."""

    rms_error_mrad: float
    max_error_mrad: float


@dataclass(frozen=True, slots=True)
class Tracking:
    """Everything measured of one gain set; `steps` by the step's size in mrad, `curves` by motion, for pictures.

    `roughness_nm` is the RMS of the torque's change from cycle to cycle on (19): what the drive and the ear feel of
    encoder steps and noise. Keys of `curves`: "paper", "step_100", "step_10".
    """

    rms_error_mrad: float
    max_error_mrad: float
    roughness_nm: float
    steps: dict[float, StepResponse]
    curves: dict[str, Curves] = field(default_factory=dict, compare=False, repr=False)

    def document(self) -> dict[str, Any]:
        """Plain values without the curves; steps by their size in mrad as text, "100" and "10"."""
        return {
            "rms_error_mrad": self.rms_error_mrad,
            "max_error_mrad": self.max_error_mrad,
            "roughness_nm": self.roughness_nm,
            "steps": {f"{size:g}": response.document() for size, response in self.steps.items()},
        }


def tracking(
    followed: Curves,
    steps: Mapping[float, Curves],
    count_rad: float,
    true_swings_rad: Mapping[float, float] | None = None,
    encoder_rms_rad: float | None = None,
) -> Tracking:
    """Judge one run of (19) and of the steps (by their size in mrad), all relative to where they began.

    `count_rad` is the encoder's resolution (0: none); `true_swings_rad` is how far the joint itself moved in each hold,
    where a world knows that; `encoder_rms_rad` is the encoder's noise beside its rounding, where it is known.
    """
    swings_rad = true_swings_rad or {}
    error = score(followed.time_s, followed.error_mrad)
    return Tracking(
        rms_error_mrad=error.rms_error_mrad,
        max_error_mrad=error.max_error_mrad,
        roughness_nm=roughness(followed.time_s, followed.torque_nm),
        steps={
            size: step_response(c.time_s, c.position_rad, size * 1e-3, count_rad, swings_rad.get(size), encoder_rms_rad)
            for size, c in steps.items()
        },
        curves={"paper": followed} | {curve_key(size): c for size, c in steps.items()},
    )


def curve_key(step_mrad: float) -> str:
    """The key of a step among the curves of a Tracking."""
    return f"step_{step_mrad:g}"


def score(time_s: Array, error_mrad: Array) -> Score:
    """RMS and largest error after SETTLE_S. Raises AnswerIsNo when the run is shorter than that."""
    judged = error_mrad[time_s >= SETTLE_S]
    if judged.size == 0:
        raise AnswerIsNo(f"the run ended within its first {SETTLE_S:.0f} s")
    return Score(float(np.sqrt(np.mean(judged**2))), float(np.max(np.abs(judged))))


def roughness(time_s: Array, torque_nm: Array) -> float:
    """RMS of the torque's change from cycle to cycle after SETTLE_S [N*m]."""
    return float(np.sqrt(np.mean(np.diff(torque_nm[time_s >= SETTLE_S]) ** 2)))


def step_response(
    time_s: Array,
    position_rad: Array,
    step_rad: float,
    count_rad: float,
    true_swing_rad: float | None = None,
    encoder_rms_rad: float | None = None,
) -> StepResponse:
    """Judge a step that is asked for at time 0; positions count from the place that was held before.

    `count_rad` is the encoder's resolution (0: none), `true_swing_rad` how far the joint itself moved in the hold,
    where that is known, `encoder_rms_rad` the encoder's noise beside its rounding, where it is known. Raises AnswerIsNo
    when the hold is shorter than HOLD_FROM_S.
    """
    held = position_rad[time_s >= HOLD_FROM_S]
    if held.size == 0:
        raise AnswerIsNo(f"the step was held for less than {HOLD_FROM_S:.0f} s")
    error, swing_rad = step_rad - position_rad, float(np.ptp(held))
    overshoot_rad = np.max(-error * np.sign(step_rad))
    sigma_rad = reading_rms(count_rad, encoder_rms_rad or 0.0)
    moves = encoder_rms_rad is not None and scatter(held) > SCATTER * max(sigma_rad, LEAST_COUNT_RAD / ROUNDING)
    return StepResponse(
        settling_s=settling(time_s, error, settling_band(step_rad, count_rad)),
        overshoot=max(0.0, float(overshoot_rad) / abs(step_rad)),
        steady_error_mrad=abs(float(np.mean(error[time_s >= time_s[-1] - STEADY_S]))) * 1e3,
        hold_mrad=1e3 * (swing_rad if true_swing_rad is None else true_swing_rad),
        hold_of=HoldOf.ENCODER if true_swing_rad is None else HoldOf.JOINT,
        hold_encoder_mrad=1e3 * swing_rad,
        hold_noise_mrad=1e3 * noise_swing(sigma_rad, len(held)),
        limit_cycle=moves or oscillates(held, float(time_s[1] - time_s[0]), max(count_rad, LEAST_COUNT_RAD)),
    )


def known_noise(gains: GainSet, count_rad: float) -> float | None:
    """Noise of the encoder's readings beside rounding, as the set's design knows it [rad]; None without one."""
    noise = noise_of(gains.design.model, count_rad) if gains.design else None
    return noise.encoder_rms if noise else None


def reading_rms(count_rad: float, encoder_rms_rad: float) -> float:
    """RMS of a reading of a joint that stands: rounding to counts, and noise beside it [rad]."""
    return math.hypot(encoder_rms_rad, count_rad / ROUNDING)


def scatter(held_rad: Array) -> float:
    """RMS of white noise that changes from cycle to cycle as `held_rad` does [rad]."""
    return float(np.sqrt(np.mean(np.diff(held_rad) ** 2) / 2.0))


def noise_swing(sigma_rad: float, count: int) -> float:
    """Peak to peak of `count` white readings [rad]: the largest of n normal values lies where one of 2*n is beyond."""
    return 2.0 * sigma_rad * NormalDist().inv_cdf(1.0 - 0.5 / count)


def settling(time_s: Array, error: Array, band: float) -> float | None:
    """Time from which the error stays within `band` to the end; None when it is outside at the end."""
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    return None if last + 1 == len(error) else float(time_s[last + 1])


def oscillates(held_rad: Array, period_s: float, count_rad: float) -> bool:
    """Whether a held position has a limit cycle, fast or slow; encoder noise, torque noise and creep are none."""
    width = round(SMOOTH_S / period_s)
    whole = len(held_rad) // width * width
    smooth: Array = held_rad[:whole].reshape(-1, width).mean(axis=1)
    hunts = whole > 0 and swings(smooth, SWING_COUNTS * count_rad) >= SWINGS
    return hunts or line_amplitude(held_rad, period_s) > LINE_COUNTS * count_rad


def line_amplitude(position_rad: Array, period_s: float) -> float:
    """Amplitude of the strongest line above LINE_FROM_HZ, over Hann windows of SEGMENT_S; 0 when there are none."""
    length = round(SEGMENT_S / period_s)
    count = len(position_rad) // length
    if count == 0:
        return 0.0
    window = np.hanning(length)
    parts = position_rad[: count * length].reshape(count, length)
    spectrum = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * window)
    power = 2.0 * np.mean(np.abs(spectrum) ** 2, axis=0) / (length * np.sum(window**2))
    line = np.convolve(power, np.ones(5), mode="same")  # a line fills three bins, and wanders a little
    return float(np.sqrt(2.0 * np.max(line[round(LINE_FROM_HZ * SEGMENT_S) :])))


def swings(position_rad: Array, width_rad: float) -> int:
    """How often the position turns and comes back by more than `width_rad`, however it drifts meanwhile."""
    lowest = highest = float(position_rad[0])
    rising, count = 0, 0
    for x in position_rad.tolist():
        lowest, highest = min(lowest, x), max(highest, x)
        if rising <= 0 and x - lowest > width_rad:
            rising, count, highest = 1, count + 1, x
        elif rising >= 0 and highest - x > width_rad:
            rising, count, lowest = -1, count + 1, x
    return count


# --- The motions -----------------------------------------------------------------------------------------------------
# The motions under which gain sets are compared: trajectory (19), then two steps that are held for a long time. They
# are the loop's own reference functions, so that simulator and axis follow the same numbers.


PAPER_S = 30.0
#: Steps one after the other, in this order and the same direction, each from where the last is held.
STEPS_MRAD = (100.0, 10.0)
HOLD_S = 20.0
#: Rest before the first motion: a change of gains fades out.
REST_S = 1.0


def paper_rows(period_s: float, duration_s: float = PAPER_S) -> Array:
    """Trajectory (19) as the simulator reads it: rows of position, velocity and acceleration, from rest."""
    samples = round(duration_s / period_s)
    return np.array([paper((k + 1) * period_s) for k in range(samples)])


def step_rows(period_s: float, step_mrad: float, duration_s: float = HOLD_S) -> Array:
    """A step from 0, held from the first sample on."""
    rows = np.zeros((round(duration_s / period_s), 3))
    rows[:, 0] = step_mrad * 1e-3
    return rows


# --- On the compiled simulator ---------------------------------------------------------------------------------------
# Tracking on the compiled simulator: the same motions and rules as over the CAN loop, hundreds of times faster. What
# the simulator leaves out: the drive's steps of torque and its rate limit.


def measure(
    model: AxisModel,
    gains: GainSet,
    *,
    counts_per_turn: float,
    cutoff_hz: float,
    seed: int,
    torque_limit_nm: float = math.inf,
    period_s: float = 0.001,
) -> Tracking:
    """Simulate `model` under `gains` on (19) and on steps of 100 and 10 mrad held for 20 s, each from rest.

    `seed` begins the model's torque and encoder noise. Curves hold what the encoder showed.
    """
    settings = LoopSettings(period_s, counts_per_turn, cutoff_hz, torque_limit_nm)
    followed = run(model, gains, paper_rows(period_s, PAPER_S), settings, seed)
    runs = {
        size: run(model, gains, step_rows(period_s, size, HOLD_S), settings, seed + 1 + i)
        for i, size in enumerate(STEPS_MRAD)
    }
    swings = {size: float(np.ptp(r.position_rad[r.t_s >= HOLD_FROM_S])) for size, r in runs.items()}
    steps = {size: curves_of(r) for size, r in runs.items()}
    heard_rad = model.noise.encoder_rms if model.noise else 0.0
    return tracking(curves_of(followed), steps, settings.resolution_rad, swings, heard_rad)


def run(model: AxisModel, gains: GainSet, rows: Array, settings: LoopSettings, seed: int) -> ClosedLoopRun:
    """One motion from rest at 0, with the model's own noise."""
    torque, reading = noise_series(model.noise, len(rows), settings.period_s, seed)
    return simulate_closed_loop(
        model,
        gains.law,
        gains.pack(),
        rows,
        settings,
        external_nm=torque,
        reading_rad=reading,
        start=(0.0, 0.0, 0.0),
    )


def curves_of(motion: ClosedLoopRun) -> Curves:
    """What an encoder and a recorder would have shown of `motion`."""
    return Curves(
        time_s=motion.t_s,
        reference_rad=motion.reference_rad,
        position_rad=motion.encoder_rad,
        torque_nm=motion.torque_nm,
        feedback_nm=motion.feedback_nm,
        friction_nm=motion.friction_nm,
        other_nm=motion.other_nm,
    )
