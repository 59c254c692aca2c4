"""Replays a recording: the model under the recorded torque, restarted from the recorded motion as often as wished.

A recording without a torque goes through the drive of the model (`servo`), whose loop is closed over the simulated
motion.

Used by `servoctl replay`, identification and diagnosis (numpy, scipy, numba where installed). The start state of a
window comes from the recording alone: position and velocity from a local cubic over the recorded position, the rest
(bristle, load, actuator) from running the model's own hidden part along the recorded motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.compiled import Kernel, available, compiled
from servod.kernels.physics.layout import PackedPlant, PlantState
from servod.kernels.physics.plant import INNER_STEP_S, delay_line, inputs
from servod.lab.simulate import open_loop, servo
from servod.lab.simulate.motion import FirstRow, Start, beginning, smoothed_motion
from servod.lab.simulate.servo import (
    ToldRows,
    against_emf,
    drive_torque,
    find_on,
    loop_gain,
    servo_numbers,
    torque_per_unit,
)

Array = NDArray[np.float64]

#: A gap longer than this and than ten samples restarts the simulation: nobody knows the torque in it.
RESTART_GAP_S = 0.02


@dataclass(frozen=True)
class Drive:
    """What a replay needs of a recording: rows of time, torque command, position, temperature (NaN = not recorded).

    SI units of the axis (rad or m). Time must not run backwards; torque and position must be finite. Where a drive was
    `told` something else than a torque, `torque` is what the model at hand makes of that (`driven`). Rows cut out of a
    recording know the `whole` of it and the row there with which they begin: a drive follows its goal and integrates
    its error from the recording's first row on.
    """

    t_s: Array
    torque: Array
    position: Array
    temperature_c: Array
    told: ToldRows | None = None
    whole: Drive | None = None
    begun: int = 0

    def part(self, rows: slice) -> Drive:
        """Some rows, which know those before them where the drive was told something else than a torque."""
        own = self.t_s[rows], self.torque[rows], self.position[rows], self.temperature_c[rows]
        if self.told is None:
            return Drive(*own)
        return Drive(*own, self.told.part(rows), self.whole or self, self.begun + rows.indices(len(self.t_s))[0])

    @cached_property
    def motion(self) -> Array:
        """Rows of position, velocity, acceleration, error of velocity (servod.lab.simulate.motion) at the rows'
        times."""
        return smoothed_motion(self.t_s, self.position)

    @cached_property
    def period_s(self) -> float:
        """Median time between rows."""
        return float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, slots=True)
class Replay:
    """What the model did: one value for each recorded row.

    `starts` are the rows where the motion restarted from the recording, `at_rest` whether it began at rest.
    """

    position: Array
    velocity: Array
    load_position: Array
    starts: NDArray[np.int64]
    at_rest: bool
    error: Array

    def over(self, rows: NDArray[np.bool_]) -> Replay:
        """The same replay with its error over some rows only."""
        return replace(self, error=self.error[rows])

    @property
    def rms(self) -> float:
        """Root mean square of simulated minus recorded position, rad or m."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def mean(self) -> float:
        """Mean distance between simulated and recorded position, rad or m."""
        return float(np.mean(np.abs(self.error)))

    @property
    def max(self) -> float:
        """Largest distance between simulated and recorded position, rad or m."""
        return float(np.max(np.abs(self.error)))


def behind_gaps(t_s: Array) -> NDArray[np.int64]:
    """Rows that follow a gap longer than RESTART_GAP_S and than ten samples: nobody knows the command in it."""
    steps = np.diff(t_s)
    if len(steps) == 0:
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(steps > max(RESTART_GAP_S, 10.0 * float(np.median(steps)))) + 1


def window_starts(t_s: Array, horizon_s: float | None) -> NDArray[np.int64]:
    """First rows of the windows: every `horizon_s` and behind every long gap; None = the first row only, whatever."""
    if horizon_s is None:
        return np.zeros(1, dtype=np.int64)
    count = math.floor((t_s[-1] - t_s[0]) / horizon_s + 1e-9)
    edges = np.searchsorted(t_s, t_s[0] + horizon_s * np.arange(1, count + 1) - 1e-6)
    rows = {0, *edges.tolist(), *behind_gaps(t_s).tolist()}
    return np.array(sorted(row for row in rows if row < len(t_s)), dtype=np.int64)


def _kernel(function: Kernel) -> Kernel:
    return compiled(function) if available() else function


def hidden_motion(packed: PackedPlant, drive: Drive, first: FirstRow, starts: NDArray[np.int64]) -> Array:
    """State at the rows `starts`: position, velocity, bristle, load position, load velocity, actuator torque.

    SI units of the axis, a row for each start. What is hidden follows the recorded motion, which began as `first` says.
    """
    motion = drive.motion[:, :3].copy()
    motion[0] = first.motion
    at_rest = inputs(packed, PlantState(temperature_c=packed.p.start_c), bare=True)
    _kernel(open_loop.recorded_motion)(*at_rest, motion)
    hidden = np.zeros((len(drive.t_s), 4))
    step_s = min(4.0 * INNER_STEP_S, drive.period_s)
    rows = drive.t_s, motion, drive.torque, first.command_before, drive.temperature_c
    _kernel(open_loop.follow)(*at_rest, *rows, hidden, step_s)
    return np.column_stack([motion[starts, :2], hidden[starts]])


def driven(model: AxisModel, drive: Drive, packed: PackedPlant | None = None) -> tuple[PackedPlant, Drive]:
    """The model packed (unless it is) and the rows with the torque that its drive makes of what the drive was told.

    The delay is in that torque then, for it is on the command's way and not on that of the motion fed back. So is the
    back-EMF of a servo, by the recorded motion; that of a drive told a voltage is viscous friction. Rows of a torque,
    and a model without a drive, come back as they are.
    """
    packed, law = packed or model.pack(), model.drive
    if law is None or drive.told is None:
        return packed, drive
    rows = drive.whole or drive
    torque = drive_torque(law, rows.told or drive.told, rows.t_s, rows.position, model.total_delay_s + law.delay_s)
    torque = torque[drive.begun : drive.begun + len(drive.t_s)]
    p = packed.p._replace(delay_s=0.0)
    if law.kind.feeds_back:
        torque = against_emf(law, drive.told, torque, drive.motion[:, 1]) if law.back_emf > 0.0 else torque
    else:
        p = p._replace(viscous=p.viscous + law.back_emf)
    return packed._replace(p=p), _with(drive, torque, drive.told)


def _with(drive: Drive, torque: Array, told: ToldRows | None) -> Drive:
    """The same rows of motion with another torque or another drive; what is known of the motion is kept."""
    moved = replace(drive, torque=torque, told=told)
    if "motion" in drive.__dict__:
        moved.__dict__["motion"] = drive.motion
    return moved


def switched_on(model: AxisModel, drive: Drive) -> Drive:
    """The rows with those marked in which the drive is off, as far as the motion says so (`servo.find_on`)."""
    law, told = model.drive, drive.told
    if law is None or told is None or not law.kind.feeds_back or not told.on.all():
        return drive
    torque = drive_torque(law, told, drive.t_s, drive.position, model.total_delay_s + law.delay_s)
    position, velocity, acceleration = drive.motion[:, 0], drive.motion[:, 1], drive.motion[:, 2]
    moved = model.inertia * acceleration - model.torque_offset
    if model.gravity is not None:
        moved = moved + model.gravity.amplitude * np.sin(position + model.gravity.phase)
    if model.spring is not None:
        moved = moved + model.spring.stiffness * (position - model.spring.rest)
    slid = moved + (model.friction.viscous + law.back_emf) * velocity
    most = (law.most or math.inf) * torque_per_unit(law, told)
    on = find_on(torque, most, (slid, moved), velocity, drive.t_s)
    return _with(drive, drive.torque, replace(told, on=on))


def replay(
    model: AxisModel | PackedPlant,
    drive: Drive,
    horizon_s: float | None,
    *,
    start: Start = Start.AUTO,
    inner_step_s: float = INNER_STEP_S,
) -> Replay:
    """Simulate `model` (or its packed parameters) under the recorded torque, restarting every `horizon_s` seconds.

    What a drive was told instead goes through the drive of the model, which a servo closes over the simulated motion.

    `horizon_s` None is one free run from the first row, gaps and all. `start` says how the first row is understood; an
    axis that was just set off counts as at rest in a free run only (`beginning`). Without numba
    the same source runs in pure Python.
    """
    packed, drive = driven(model, drive) if isinstance(model, AxisModel) else (model, drive)
    starts = window_starts(drive.t_s, horizon_s)
    rows = drive.t_s, drive.torque, drive.position, drive.motion
    first = beginning(start, *rows, free=horizon_s is None).under(packed.p.delay_s)
    states = hidden_motion(packed, drive, first, starts)
    begun = inputs(packed, PlantState(temperature_c=packed.p.start_c, first_s=float(drive.t_s[0])), bare=True)
    line = np.array(delay_line(0.0, inner_step_s))
    out = np.zeros((len(drive.t_s), 4))
    if isinstance(model, AxisModel) and model.drive is not None and drive.told and model.drive.kind.feeds_back:
        _run_closed(begun, line, model, drive, starts, states, out, inner_step_s)
    else:
        held = drive.t_s, drive.torque, first.command_before, drive.temperature_c
        _kernel(open_loop.run)(*begun, line, *held, starts, states, out, inner_step_s)
    return Replay(out[:, 0], out[:, 1], out[:, 2], starts, first.at_rest, out[:, 0] - drive.position)


def _run_closed(
    begun: tuple[Any, ...],
    line: Array,
    model: AxisModel,
    drive: Drive,
    starts: NDArray[np.int64],
    states: Array,
    out: Array,
    inner_step_s: float,
) -> None:
    """Run the axis with its servo's loop closed; integral parts begin as the recorded motion makes them."""
    law, told = model.drive, drive.told
    if law is None or told is None:
        raise ValueError("a servo and what it was told")
    t_s, delay_s = drive.t_s, model.total_delay_s + law.delay_s
    totals = servo.recorded_totals(law, told, t_s, drive.position, delay_s)[starts]
    goals = servo.followed_at(law, t_s, told.command, delay_s, starts)
    rows = loop_gain(law, told), torque_per_unit(law, told), told.on, drive.temperature_c
    _kernel(servo.run_closed)(
        *begun, line, servo_numbers(law, model.inertia), t_s, told.command, delay_s, *rows, starts, states, totals,
        goals, out, inner_step_s,
    )  # fmt: skip
