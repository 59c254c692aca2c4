"""What is told about a run: tracking error, roughness of the torque, and how a step settles and is held.

Behind the recorder and the simulator alike: plain arrays in, plain numbers out, so that a measured and a simulated run
are judged by the same rules. Needs numpy (the lab part).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.errors import AnswerIsNo
from servod.report.curves import thin

Array = NDArray[np.float64]

#: Trajectory (19) is scored without its first second, in which the axis starts to move.
SETTLE_S = 1.0
#: A step has settled when its error stays below this share of the step ...
BAND_SHARE = 0.02
#: ... or below this many encoder counts, where that is more: below it the encoder tells nothing.
BAND_COUNTS = 3.0
#: What is held is judged from here after the step on, whether or not it has settled.
HOLD_FROM_S = 1.0
#: The steady error is the mean of the last part of the hold.
STEADY_S = 1.0
#: A limit cycle swings by more than this many counts, peak to peak: three is what noise of a count shows in 20 s ...
CYCLE_COUNTS = 3.5
#: ... or by more than this where the encoder has no steps [rad] ...
CYCLE_LEAST_RAD = 1e-5
#: ... and swings so many times while it is held: two whole periods. Creep goes one way.
CYCLE_SWINGS = 4


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

    def thinned(self, points: int = 2400) -> dict[str, tuple[Array, Array]]:
        """(time, values) of each series with at most about `points` values, highest and lowest of each bin kept.

        Keys: the attribute names, `error_mrad` among them. Every series is thinned by itself, so that no peak is lost.
        """
        names = ("reference_rad", "position_rad", "error_mrad", "torque_nm", "feedback_nm", "friction_nm", "other_nm")
        return {name: thin(self.time_s, getattr(self, name), points) for name in names}


@dataclass(frozen=True, slots=True)
class StepResponse:
    """One step and its hold. `settling_s` is None when the error does not come to stay within the band.

    `overshoot` is a share of the step, `steady_error_mrad` the mean error at the end of the hold, without sign,
    `hold_mrad` peak to peak of the position from HOLD_FROM_S on.
    """

    settling_s: float | None
    overshoot: float
    steady_error_mrad: float
    hold_mrad: float
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


def tracking(followed: Curves, steps: Mapping[float, Curves], count_rad: float) -> Tracking:
    """Judge one run of (19) and of the steps (by their size in mrad), all relative to where they began.

    `count_rad` is the encoder's resolution (0: none).
    """
    error = score(followed.time_s, followed.error_mrad)
    return Tracking(
        rms_error_mrad=error.rms_error_mrad,
        max_error_mrad=error.max_error_mrad,
        roughness_nm=roughness(followed.time_s, followed.torque_nm),
        steps={size: step_response(c.time_s, c.position_rad, size * 1e-3, count_rad) for size, c in steps.items()},
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


def step_response(time_s: Array, position_rad: Array, step_rad: float, count_rad: float) -> StepResponse:
    """Judge a step that is asked for at time 0; positions count from the place that was held before.

    `count_rad` is the encoder's resolution (0: none). Raises AnswerIsNo when the hold is shorter than HOLD_FROM_S.
    """
    held = position_rad[time_s >= HOLD_FROM_S]
    if held.size == 0:
        raise AnswerIsNo(f"the step was held for less than {HOLD_FROM_S:.0f} s")
    error = step_rad - position_rad
    beyond = np.max(-error * np.sign(step_rad))
    return StepResponse(
        settling_s=settling(time_s, error, max(BAND_SHARE * abs(step_rad), BAND_COUNTS * count_rad)),
        overshoot=max(0.0, float(beyond) / abs(step_rad)),
        steady_error_mrad=abs(float(np.mean(error[time_s >= time_s[-1] - STEADY_S]))) * 1e3,
        hold_mrad=float(np.ptp(held)) * 1e3,
        limit_cycle=swings(held, max(CYCLE_COUNTS * count_rad, CYCLE_LEAST_RAD)) >= CYCLE_SWINGS,
    )


def settling(time_s: Array, error: Array, band: float) -> float | None:
    """Time from which the error stays within `band` to the end; None when it is outside at the end."""
    outside = np.flatnonzero(np.abs(error) > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    return None if last + 1 == len(error) else float(time_s[last + 1])


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
