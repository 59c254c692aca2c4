"""One experiment's recording as arrays, and the list of all of them: what every fit takes.

Between the axis, the recordings on disk, and the fits.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from servod.lab.recordings.recording import Rows

Array = NDArray[np.float64]


class ExperimentKind(StrEnum):
    """What a recording was made for; each has its file in `experiments`."""

    NOISE = "noise"
    BREAK_AWAY = "break_away"
    PRESLIDING = "presliding"
    KICK = "kick"
    RESPONSE = "response"
    BRISTLE = "bristle"
    FRICTION_MAP = "friction_map"


@dataclass(frozen=True)
class RecordedMotion:
    """One motion, a value for each cycle in SI units; `settings` are what the fit must know of the experiment.

    `motor_rad` is the joint's position by the amplifier's own sensor; `sha256` is the hash of the recording's file.
    """

    kind: ExperimentKind
    t_s: Array
    torque_nm: Array
    position_rad: Array
    reference_rad: Array
    excitation_nm: Array
    torque_actual_nm: Array
    motor_rad: Array
    settings: dict[str, float] = field(default_factory=dict)
    sha256: str = ""

    @property
    def period_s(self) -> float:
        """Median time between two cycles."""
        return float(np.median(np.diff(self.t_s)))

    def __len__(self) -> int:
        return len(self.t_s)


def trace_of(kind: ExperimentKind, rows: Rows, settings: dict[str, float]) -> RecordedMotion:
    """The trace in cycle records (dtype servod.lab.recordings.recording.ROW)."""
    time_ns = rows["time_ns"]
    return RecordedMotion(
        kind,
        (time_ns - time_ns[0]) * 1e-9,
        rows["torque_nm"].copy(),
        rows["position_rad"].copy(),
        rows["reference_rad"].copy(),
        rows["torque_other_nm"].copy(),
        rows["torque_actual_nm"].copy(),
        rows["motor_position_rad"].copy(),
        settings,
    )


# --- Signals for regressions -----------------------------------------------------------------------------------------
# Recorded signals made ready for regressions: torque shifted by the delay, position smoothed and differentiated. Torque
# and position pass the same Gaussian kernel, so that a linear equation between them stays true.


#: The kernel reaches this many standard deviations to each side.
REACH = 4.0


class Smooth(NamedTuple):
    """Smoothed signals of one motion, on its own time steps; the ends, where the kernel has no data, are cut."""

    t_s: Array
    torque: Array
    position: Array
    velocity: Array
    acceleration: Array


def acting_torque(torque: Array, delay_s: float, period_s: float) -> Array:
    """Torque that acts, averaged over each period centred on its sample, of commands held for a period each.

    A command of sample k acts from t_k + delay for one period; before the first, the first is taken.
    """
    shift = delay_s / period_s + 0.5
    whole = int(np.floor(shift))
    part = shift - whole
    padded = np.concatenate([np.full(whole + 1, torque[0]), torque])
    count = len(torque)
    new, old = padded[1 : 1 + count], padded[:count]
    blended: Array = (1.0 - part) * new + part * old
    return blended


def smooth(t_s: Array, torque: Array, position: Array, delay_s: float, width_s: float) -> Smooth:
    """Torque at the joint, position and its derivatives through a Gaussian of standard deviation `width_s`."""
    period = float(np.median(np.diff(t_s)))
    half = max(2, int(np.ceil(REACH * width_s / period)))
    k = np.arange(-half, half + 1) * period
    kernel = np.exp(-0.5 * (k / width_s) ** 2)
    kernel /= kernel.sum()
    slope = kernel * k  # least-squares exact on lines and parabolas, up to the discrete moments
    slope /= np.sum(slope * k)
    bend = kernel * (k**2 - np.sum(kernel * k**2))
    bend *= 2.0 / np.sum(bend * k**2)
    acting = acting_torque(torque, delay_s, period)
    inside = slice(half, len(t_s) - half)
    filtered = (convolve1d(s, kernel[::-1]) for s in (acting, position))
    derivatives = (convolve1d(position, kern[::-1]) for kern in (slope, bend))
    return Smooth(t_s[inside], *(s[inside] for s in filtered), *(s[inside] for s in derivatives))
