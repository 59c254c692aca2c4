"""Reference motions of the loop: where the joint shall be in this cycle. Stands on commands and math.

All motions start at the reference position that holds when they begin and add to it. Time runs on a scale between 0 and
1 ("feed hold"): halting and braking lower the scale smoothly, so that the path stays the same and only slows down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from servod.kernels.motions import (
    PAPER_AMPLITUDE_RAD,
    PAPER_LONGEST_S,
    PAPER_OMEGA_RAD_PER_S,
    Sample,
    Samples,
    paper,
    sine,
    table,
    torque_table,
)
from servod.runtime.loop.commands import ReferenceKind, Refusal


class Motion(NamedTuple):
    """One motion: its path over time (position, velocity, acceleration), its duration and its extent, all relative.

    An excitation adds `torque_nm` over time, and ends when the joint's distance from the reference has changed by more
    than `window_rad` since the motion began.
    """

    path: Callable[[float], Sample]
    duration_s: float
    lowest_rad: float
    highest_rad: float
    torque_nm: Callable[[float], float] | None = None
    window_rad: float = math.inf
    speed_rad_s: float = 0.0  # fastest of the path where it is known; the sender of a table checks it

    def first_rad(self, period_s: float) -> float:
        """How far the reference goes in the first cycle, rad: all of a step."""
        return self.path(min(period_s, self.duration_s))[0]


def make_motion(arguments: Sequence[float], period_s: float, trajectory: Samples) -> Motion | Refusal:
    """The motion that Op.REFERENCE's arguments describe; `trajectory` is the shared area that TABLE reads from."""
    if not arguments or not all(math.isfinite(a) for a in arguments):
        return Refusal.BAD_ARGUMENT
    kind, *rest = arguments
    builder = _BUILDERS.get(int(kind))
    if builder is None:
        return Refusal.BAD_ARGUMENT
    try:
        return builder(rest, period_s, trajectory)
    except (ValueError, IndexError):
        return Refusal.BAD_ARGUMENT


def _hold(_rest: Sequence[float], _period_s: float, _trajectory: Samples) -> Motion:
    return Motion(lambda _t: (0.0, 0.0, 0.0), 0.0, 0.0, 0.0)


def _sine(rest: Sequence[float], _period_s: float, _trajectory: Samples) -> Motion:
    amplitude_rad, frequency_hz, duration_s = rest
    if frequency_hz <= 0.0 or duration_s <= 0.0:
        raise ValueError("frequency and duration are positive")
    extent_rad = abs(amplitude_rad)
    speed_rad_s = extent_rad * 2.0 * math.pi * frequency_hz
    return Motion(sine(amplitude_rad, frequency_hz), duration_s, -extent_rad, extent_rad, speed_rad_s=speed_rad_s)


def _paper(rest: Sequence[float], _period_s: float, _trajectory: Samples) -> Motion:
    (duration_s,) = rest
    if not 0.0 < duration_s <= PAPER_LONGEST_S:
        raise ValueError("the envelope of (19) ends at 30.3 s")
    speed_rad_s = PAPER_AMPLITUDE_RAD * PAPER_OMEGA_RAD_PER_S
    return Motion(paper, duration_s, -PAPER_AMPLITUDE_RAD, PAPER_AMPLITUDE_RAD, speed_rad_s=speed_rad_s)


def _step(rest: Sequence[float], _period_s: float, _trajectory: Samples) -> Motion:
    amplitude_rad, duration_s = rest
    if duration_s <= 0.0:
        raise ValueError("duration is positive")
    return Motion(lambda _t: (amplitude_rad, 0.0, 0.0), duration_s, min(0.0, amplitude_rad), max(0.0, amplitude_rad))


def _table(rest: Sequence[float], period_s: float, trajectory: Samples) -> Motion:
    samples, lowest_rad, highest_rad = int(rest[0]), rest[1], rest[2]
    if not 2 <= samples <= len(trajectory):
        raise ValueError("between 2 samples and the size of the trajectory area")
    first_rad = _first_of(trajectory)
    path = table(trajectory, samples, period_s)
    return Motion(path, (samples - 1) * period_s, lowest_rad - first_rad, highest_rad - first_rad)


def _excite(rest: Sequence[float], period_s: float, trajectory: Samples) -> Motion:
    samples, lowest_rad, highest_rad, window_rad = int(rest[0]), rest[1], rest[2], rest[3]
    if not 2 <= samples <= len(trajectory) // 2 or window_rad <= 0.0:
        raise ValueError("between 2 samples and half the trajectory area; a positive window")
    torque = torque_table(trajectory, samples, samples, period_s)
    first_rad, duration_s = _first_of(trajectory), (samples - 1) * period_s
    path = table(trajectory, samples, period_s)
    return Motion(path, duration_s, lowest_rad - first_rad, highest_rad - first_rad, torque, window_rad)


def _first_of(trajectory: Samples) -> float:
    if not math.isfinite(trajectory[0]):  # what a bent table begins with
        raise ValueError("samples are finite")
    return trajectory[0]


_BUILDERS: dict[int, Callable[[Sequence[float], float, Samples], Motion]] = {
    ReferenceKind.HOLD: _hold,
    ReferenceKind.SINE: _sine,
    ReferenceKind.PAPER: _paper,
    ReferenceKind.STEP: _step,
    ReferenceKind.TABLE: _table,
    ReferenceKind.EXCITE: _excite,
}


class Reference:
    """The running reference: base position plus motion, on a time scale that halting and braking lower smoothly."""

    def __init__(self, scale_time_s: float) -> None:
        """`scale_time_s`: how long the time scale takes from 1 to 0 and back."""
        self._scale_rate_per_s = 1.0 / scale_time_s
        self.position_rad, self.velocity_rad_s, self.acceleration_rad_s2 = 0.0, 0.0, 0.0
        self.torque_nm = 0.0
        self.active = self._leaving = False
        self._motion: Motion | None = None
        self._first_distance_rad = math.nan
        self._base_rad = self._time_s = 0.0
        self._scale = self._wanted_scale = 1.0

    @property
    def at_rest(self) -> bool:
        """No motion, or its time stands still."""
        return not self.active or self._scale == 0.0

    @property
    def injects(self) -> bool:
        """The motion adds torque of its own."""
        return self._motion is not None and self._motion.torque_nm is not None

    def hold(self, position_rad: float) -> None:
        """End any motion; stay at `position_rad`."""
        self.active, self._motion, self._base_rad = False, None, position_rad
        self.position_rad, self.velocity_rad_s, self.acceleration_rad_s2 = position_rad, 0.0, 0.0
        self.torque_nm, self._leaving = 0.0, False
        self._scale = self._wanted_scale = 1.0

    def start(self, motion: Motion) -> None:
        """Begin `motion` from the present reference position."""
        self._motion, self._base_rad, self._time_s = motion, self.position_rad, 0.0
        self.active, self._scale, self._wanted_scale = motion.duration_s > 0.0, 1.0, 1.0
        self._leaving, self._first_distance_rad = False, math.nan

    def halt(self, on: bool, leave: bool = False) -> None:
        """Let time slow down to a stand (`on`) or run again; with `leave` the motion ends there."""
        self._leaving = self._leaving or (leave and self.active)
        self._wanted_scale = 0.0 if on or self._leaving else 1.0

    def watch(self, position_rad: float) -> None:
        """Begin to fade the motion out once the joint is outside its window."""
        if not self.active or self._motion is None:
            return
        distance_rad = position_rad - self.position_rad
        if math.isnan(self._first_distance_rad):
            self._first_distance_rad = distance_rad
        if abs(distance_rad - self._first_distance_rad) > self._motion.window_rad:
            self._leaving, self._wanted_scale = True, 0.0

    def advance(self, dt_s: float) -> None:
        """Move time on by `dt_s`, as the scale has it, and take the new reference."""
        if not self.active or self._motion is None:
            return
        before = self._scale
        self._change_scale(dt_s)
        self._time_s += dt_s * self._scale
        if self._time_s >= self._motion.duration_s:
            self._finish(self._motion)
            return
        if self._leaving and self._scale == 0.0:
            self.hold(self.position_rad)
            return
        x, v, a = self._motion.path(self._time_s)
        scale = self._scale
        self.position_rad = self._base_rad + x
        self.velocity_rad_s = v * scale
        self.acceleration_rad_s2 = a * scale * scale + v * (scale - before) / dt_s  # chain rule: x(tau(t))
        self.torque_nm = 0.0 if self._motion.torque_nm is None else scale * self._motion.torque_nm(self._time_s)

    def _change_scale(self, dt_s: float) -> None:
        step = self._scale_rate_per_s * dt_s
        self._scale += min(max(self._wanted_scale - self._scale, -step), step)

    def _finish(self, motion: Motion) -> None:
        """Stay where the motion ends."""
        self.hold(self._base_rad + motion.path(motion.duration_s)[0])
