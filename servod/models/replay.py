"""Replays a recording: the model under the recorded torque, restarted from the recorded motion as often as wished.

Used by `servoctl replay`, identification and diagnosis (numpy, scipy, numba where installed). The start state of a
window comes from the recording alone: position and velocity from a local cubic over the recorded position, the rest
(bristle, load, actuator) from running the model's own hidden part along the recorded motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from servod.axis_model import AxisModel
from servod.models import open_loop
from servod.models.compiled import Kernel, available, compiled
from servod.models.layout import S_TEMPERATURE_C, S_TORQUE
from servod.models.motion import noise_rms, smoothed_motion
from servod.models.plant import INNER_STEP_S, rest_state

Array = NDArray[np.float64]

#: A free run over a recording whose first speed is under this share of its RMS speed starts at rest: people start
#: recorders before the motion, and the one-sided fit at the first row is the poorest of all.
AT_REST_SHARE = 0.1

#: Within this time an axis leaves its rest when the first recorded torque is new to it, s.
SETTING_OFF_S = 0.05

#: A gap longer than this and than ten samples restarts the simulation: nobody knows the torque in it.
RESTART_GAP_S = 0.02


@dataclass(frozen=True)
class Drive:
    """What a replay needs of a recording: rows of time, torque command, position, temperature (NaN = not recorded).

    SI units of the axis (rad or m). Time must not run backwards; torque and position must be finite.
    """

    t_s: Array
    torque: Array
    position: Array
    temperature_c: Array

    @cached_property
    def motion(self) -> Array:
        """Rows of position, velocity, acceleration (servod.models.motion), on the rows' own times."""
        return smoothed_motion(self.t_s, self.position)

    @cached_property
    def starts_at_rest(self) -> bool:
        """Whether the first speed is next to nothing against the speeds of the recording."""
        speed = self.motion[:, 1]
        return bool(abs(speed[0]) <= AT_REST_SHARE * np.sqrt(np.mean(speed**2)))

    @cached_property
    def stands_still(self) -> bool:
        """Whether the first two rows show one position, within noise: the axis rests at the first row, surely."""
        first = abs(float(self.position[1] - self.position[0]))
        return self.starts_at_rest and first <= 4.0 * noise_rms(self.position)

    @cached_property
    def torque_before(self) -> float:
        """The command before the first row: 0 when the axis rests and then sets off, else the first row's.

        An axis that rests under the first row's torque stays where it is; one that leaves at once was not under it.
        """
        early = self.position[self.t_s <= self.t_s[0] + SETTING_OFF_S]
        leaves = float(np.max(np.abs(early - self.position[0]))) > 5.0 * noise_rms(self.position)
        return 0.0 if self.starts_at_rest and leaves else float(self.torque[0])

    @cached_property
    def period_s(self) -> float:
        """Median time between rows."""
        return float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, slots=True)
class Replay:
    """What the model did: one value for each recorded row; `starts` are the rows where the motion restarted."""

    position: Array
    velocity: Array
    load_position: Array
    starts: NDArray[np.int64]
    error: Array

    def over(self, rows: NDArray[np.bool_]) -> Replay:
        """The same replay with its error over some rows only."""
        return replace(self, error=self.error[rows])

    @property
    def rms(self) -> float:
        """Root mean square of simulated minus recorded position, rad or m."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def max(self) -> float:
        """Largest distance between simulated and recorded position, rad or m."""
        return float(np.max(np.abs(self.error)))


def window_starts(t_s: Array, horizon_s: float | None) -> NDArray[np.int64]:
    """First rows of the windows: every `horizon_s` (None = the first row only), and behind every long gap."""
    rows = {0}
    if horizon_s is not None:
        count = math.floor((t_s[-1] - t_s[0]) / horizon_s + 1e-9)
        edges = t_s[0] + horizon_s * np.arange(1, count + 1) - 1e-6
        rows |= set(np.searchsorted(t_s, edges).tolist())
    steps = np.diff(t_s)
    if len(steps):
        gap = max(RESTART_GAP_S, 10.0 * float(np.median(steps)))
        rows |= set((np.flatnonzero(steps > gap) + 1).tolist())
    return np.array(sorted(row for row in rows if row < len(t_s)), dtype=np.int64)


def _kernel(function: Kernel) -> Kernel:
    return compiled(function) if available() else function


def start_states(parameters: Array, drive: Drive, starts: NDArray[np.int64]) -> Array:
    """State at the rows `starts`: position, velocity, bristle, load position, load velocity, actuator torque."""
    state = _fresh_state(drive)
    hidden = np.zeros((len(drive.t_s), 4))
    motion = drive.motion.copy()
    if drive.stands_still or (len(starts) == 1 and drive.starts_at_rest):
        motion[0] = drive.position[0], 0.0, 0.0
    follow = _kernel(open_loop.follow)
    step_s = min(4.0 * INNER_STEP_S, drive.period_s)
    follow(parameters, state, drive.t_s, motion, drive.torque, drive.torque_before, drive.temperature_c, hidden, step_s)
    return np.column_stack([motion[starts, :2], hidden[starts]])


def _fresh_state(drive: Drive) -> Array:
    state = np.array(rest_state(0.0))
    state[S_TORQUE] = drive.torque_before
    if not math.isnan(drive.temperature_c[0]):
        state[S_TEMPERATURE_C] = drive.temperature_c[0]
    return state


def replay(
    model: AxisModel | Sequence[float],
    drive: Drive,
    horizon_s: float | None,
    *,
    inner_step_s: float = INNER_STEP_S,
) -> Replay:
    """Simulate `model` (or its packed parameters) under the recorded torque, restarting every `horizon_s` seconds.

    `horizon_s` None is one free run from the first row. Without numba the same source runs in pure Python.
    """
    packed = model.pack() if isinstance(model, AxisModel) else model
    parameters = np.array(packed, dtype=np.float64)
    starts = window_starts(drive.t_s, horizon_s)
    states = start_states(parameters, drive, starts)
    out = np.zeros((len(drive.t_s), 3))
    run = _kernel(open_loop.run)
    run(
        parameters,
        _fresh_state(drive),
        drive.t_s,
        drive.torque,
        drive.torque_before,
        drive.temperature_c,
        starts,
        states,
        out,
        inner_step_s,
    )
    return Replay(out[:, 0], out[:, 1], out[:, 2], starts, out[:, 0] - drive.position)
