"""What a drive makes of its command: torque for each recorded row, and the axis with its servo's loop closed.

Stands beside `replay`, for recordings without a torque. Two views of one law (`servod.formats.model.drive`): over the
recorded motion (`drive_torque`), where the recorded goal and position give the torque that acted, and on the simulated
motion (`run_closed`), where the servo acts on what the model does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.drive import DriveKind, DriveLaw
from servod.kernels.physics.dynamics import advance
from servod.kernels.physics.effects import encoder_position
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables
from servod.lab.simulate.open_loop import acting, acts_until, begin, inner_steps, switch_row

Array = NDArray[np.float64]
Rows = NDArray[np.bool_]

#: A servo's own loop runs at about a kilohertz: its duty is held for so long, s.
LOOP_PERIOD_S = 1e-3

#: Back-EMF acts at once; its torque is held for at most this share of the time in which it would stop the motor.
EMF_STEP = 0.1


@dataclass(frozen=True)
class ToldRows:
    """What a recording says of its drive, a value for each row: the command that it was told, in the unit of its kind
    (rad, rad/s, V or A; m when linear), its gain `kp` and its supply in V (NaN where not recorded), and whether it is
    on: one that is off makes no torque."""

    command: Array
    gain: Array
    supply_v: Array
    on: NDArray[np.bool_]

    def part(self, rows: slice) -> ToldRows:
        """The same over some rows."""
        return ToldRows(self.command[rows], self.gain[rows], self.supply_v[rows], self.on[rows])


def torque_per_unit(law: DriveLaw, told: ToldRows) -> Array:
    """Torque of a duty, volt or ampere of one in each row, N*m. Raises ValueError where the law does not say."""
    factor = law.factor
    if factor is None:
        raise ValueError("a drive whose torque_per_command is unknown")
    if not law.by_supply:
        return np.full(len(told.command), factor)
    known = law.supply_v if law.supply_v is not None else math.nan
    return factor * np.where(np.isfinite(told.supply_v), told.supply_v, known)


def loop_gain(law: DriveLaw, told: ToldRows) -> Array:
    """Duty per rad of error in each row (duty*s/rad with kind velocity)."""
    own = np.full(len(told.command), law.kp) if law.kp is not None else told.gain
    return law.gain_scale * own


class FollowedGoal(NamedTuple):
    """What a drive makes of its goal before it acts: where it stands at each row, and its mean over each row's step."""

    at_row: Array
    mean: Array


def followed(law: DriveLaw, t_s: Array, command: Array) -> FollowedGoal:
    """The command as the drive follows it, from the first row's on: no faster than `goal_rate`."""
    if law.goal_rate is None:
        return FollowedGoal(command, command)
    step = np.diff(t_s, append=t_s[-1] + (t_s[-1] - t_s[-2]))
    at_row, mean = command.copy(), command.copy()
    goal = float(command[0])
    for row, (wanted, most) in enumerate(zip(command.tolist(), (law.goal_rate * step).tolist(), strict=True)):
        at_row[row], way = goal, wanted - goal
        if abs(way) <= most:  # there before the next row: what is missing on the way is half a triangle
            mean[row] = wanted - 0.5 * way * (abs(way) / most if most > 0.0 else 0.0)
            goal = wanted
        else:
            mean[row] = goal + math.copysign(0.5 * most, way)
            goal += math.copysign(most, way)
    return FollowedGoal(at_row, mean)


def followed_at(law: DriveLaw, t_s: Array, command: Array, delay_s: float, rows: NDArray[np.int64]) -> Array:
    """Where a goal that comes `delay_s` late stands at some rows: the start of windows."""
    return np.interp(t_s[rows] - delay_s, t_s, followed(law, t_s, command).at_row)


def mean_arriving(t_s: Array, command: Array, delay_s: float) -> Array:
    """Mean over each row's step of a command that is held over its sample and arrives `delay_s` late.

    Before the first row its command is taken to have stood; the mean is smooth in the delay.
    """
    ends = np.append(t_s, t_s[-1] + (t_s[-1] - t_s[-2]))
    area = np.concatenate([[0.0], np.cumsum(command * np.diff(ends))])
    late = ends - delay_s
    reached = np.where(late < t_s[0], command[0] * (late - t_s[0]), np.interp(late, ends, area))
    span = np.diff(ends)
    return np.asarray(np.where(span > 0.0, np.diff(reached) / np.maximum(span, 1e-12), command))


def drive_torque(law: DriveLaw, told: ToldRows, t_s: Array, position: Array, delay_s: float) -> Array:
    """Torque that acted over each row's step, N*m: the law on the recorded command and the recorded motion.

    `delay_s` is on the command's way alone: what the servo feeds back is its own measurement.
    """
    came = mean_arriving(t_s, followed(law, t_s, told.command).mean, delay_s)
    if law.kind.feeds_back:
        came = _duty(law, told, t_s, position, came)
    most = law.most
    made = torque_per_unit(law, told) * (came if most is None else np.clip(came, -most, most))
    return np.where(told.on, made, 0.0)


def against_emf(law: DriveLaw, told: ToldRows, torque: Array, velocity: Array) -> Array:
    """What is left of the drive's torque over each row's step behind the back-EMF of the recorded motion, N*m.

    The current makes the torque that the gears carry, and it is what the back-EMF leaves of the voltage.
    """
    mean = 0.5 * (velocity + np.append(velocity[1:], velocity[-1]))
    return np.where(told.on, torque - law.back_emf * mean, 0.0)


def _duty(law: DriveLaw, told: ToldRows, t_s: Array, position: Array, goal: Array) -> Array:
    """The duty that the loop asks for, before its limit."""
    step, error, speed = _errors(law, t_s, position, goal)
    duty = loop_gain(law, told) * error
    if law.kd > 0.0:
        duty = duty - law.gain_scale * law.kd * speed
    return duty + _integral(law, step, error) if law.ki > 0.0 else duty


def _errors(law: DriveLaw, t_s: Array, position: Array, goal: Array) -> tuple[Array, Array, Array]:
    """Length of each row's step, and error behind the dead band and speed, both as means over it."""
    step = np.diff(t_s, append=t_s[-1] + (t_s[-1] - t_s[-2]))
    behind = np.append(position[1:], 2.0 * position[-1] - position[-2])
    speed = (behind - position) / np.maximum(step, 1e-9)
    error = goal - (0.5 * (position + behind) if law.kind is DriveKind.POSITION_SERVO else speed)
    return step, np.where(np.abs(error) <= law.dead_band, 0.0, error), speed


def recorded_totals(law: DriveLaw, told: ToldRows, t_s: Array, position: Array, delay_s: float) -> Array:
    """The integral part in each row as the recorded motion makes it; nothing where the law has none."""
    if law.ki == 0.0:
        return np.zeros(len(t_s))
    came = mean_arriving(t_s, followed(law, t_s, told.command).mean, delay_s)
    step, error, _ = _errors(law, t_s, position, came)
    return _integral(law, step, error)


def _integral(law: DriveLaw, step: Array, error: Array) -> Array:
    """The integral part in each row, from none at the first, within the limit (no wind-up)."""
    most = law.most or math.inf
    found, total = np.zeros(len(error)), 0.0
    for row in range(len(error)):
        found[row] = total
        total = min(max(total + law.gain_scale * law.ki * error[row] * step[row], -most), most)
    return found


# --- A drive that is off ---------------------------------------------------------------------------------------------
# Recordings of a drop, or of a servo whose protection has tripped, ask for a goal that nothing follows any more.


#: A drive is off where, for so long, s, it would push with this share of the most that it can ...
OFF_LEAST_S, OFF_PUSHES = 0.3, 0.9

#: ... and what the motion needs is at most this share of it: a drive that is stalled holds what it pushes against.
OFF_NEEDS = 0.2

#: What goes to its goal in this share of the rows is driven, at a limited rate: an axis that is off falls or rests.
DRIVEN = 0.8

#: Slower than this share of a high speed of the recording is at rest.
SLOW = 0.05


def find_on(torque: Array, most: Array, needed: tuple[Array, Array], velocity: Array, t_s: Array) -> Rows:
    """Rows in which a drive is on, by what the motion needed.

    `torque` is what the drive makes when it is on, `most` the largest that it can; `needed` the torque of the model's
    motion without dry friction: all of it, and what is left without viscous friction and back-EMF. Full torque that
    nothing stands against tells that the drive is off, unless the axis goes on to its goal all the while (`velocity`);
    it is for as long before and after as it saves squares to leave out its torque.
    """
    on = np.ones(len(torque), dtype=bool)
    whole, bare = needed
    pushed = (np.abs(torque) >= OFF_PUSHES * most) & (np.abs(whole) <= OFF_NEEDS * np.abs(torque))
    saved = (whole - torque) ** 2 - np.minimum(whole**2, bare**2)
    follows = velocity * np.sign(torque) > SLOW * float(np.quantile(np.abs(velocity), 0.98))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], pushed.astype(np.int8), [0]])))
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if t_s[end - 1] - t_s[first] >= OFF_LEAST_S and float(np.mean(follows[first:end])) < DRIVEN:
            on[first - _longest(saved[:first][::-1]) : end + _longest(saved[end:])] = False
    return on


def _longest(saved: Array) -> int:
    """How many rows to take for the greatest sum; none where every sum is a loss."""
    total = np.cumsum(saved)
    return int(np.argmax(total)) + 1 if len(total) and float(np.max(total)) > 0.0 else 0


# --- The loop closed -------------------------------------------------------------------------------------------------
# The servo acts on the simulated position: what a replay and free windows of such a recording are.


class ServoNumbers(NamedTuple):
    """The law as the kernel takes it, its torque held for `loop_s`; gain and torque per duty come row by row."""

    on_speed: bool
    ki: float
    kd: float
    dead_band: float
    limit: float
    goal_rate: float
    emf: float
    loop_s: float


def servo_numbers(law: DriveLaw, inertia: float) -> ServoNumbers:
    """The numbers of a law that feeds back, on a motor of this inertia."""
    most = law.most if law.most is not None else math.inf
    kd, ki = law.gain_scale * law.kd, law.gain_scale * law.ki
    rate = law.goal_rate if law.goal_rate is not None else math.inf
    emf = law.back_emf
    loop_s = min(LOOP_PERIOD_S, EMF_STEP * inertia / emf) if emf > 0.0 else LOOP_PERIOD_S
    return ServoNumbers(law.kind is DriveKind.VELOCITY, ki, kd, law.dead_band, most, rate, emf, loop_s)


def servo_duty(
    n: ServoNumbers, gain: float, goal: float, position: float, velocity: float, total: float, h: float
) -> tuple[float, float]:
    """Duty behind the limit, and the integral part after `h` seconds."""
    error = goal - (velocity if n.on_speed else position)
    if abs(error) <= n.dead_band:
        error = 0.0
    duty = gain * error - n.kd * velocity + total
    total = min(max(total + n.ki * error * h, -n.limit), n.limit)
    return min(max(duty, -n.limit), n.limit), total


def run_closed(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: Any,
    n: ServoNumbers,
    t: Any,
    goal: Any,
    delay_s: float,
    gain: Any,
    factor: Any,
    on: Any,
    temperature: Any,
    starts: Any,
    start_states: Any,
    totals: Any,
    goals: Any,
    out: Any,
    step_s: float,
) -> None:
    """`open_loop.run` with the servo's loop closed over the simulated motion.

    `goal` of a row arrives `delay_s` late, `gain` and `factor` (N*m at full duty) hold from their rows on, `totals` are
    the integral parts and `goals` the goals as followed at the rows in `starts`. Where the drive is not `on` there is
    no torque and no back-EMF.
    `out` gets encoder position, velocity, load position, and torque.
    """
    window, row, total, aim = 0, -1, 0.0, goal[0]
    for k in range(len(t)):
        s.time_s = t[k]
        if window < len(starts) and starts[window] == k:
            begin(s, start_states[window])
            total, aim = totals[window], goals[window]
            window += 1
        out[k, 0], out[k, 1] = encoder_position(p, tables, s.position), s.velocity
        out[k, 2], out[k, 3] = s.load_position, s.torque
        if k + 1 == len(t):
            break
        now = t[k]
        while now < t[k + 1]:
            row = switch_row(t, row, now, delay_s)
            end = acts_until(t, row, delay_s, t[k + 1])
            pieces = inner_steps(end - now, n.loop_s)
            h = (end - now) / pieces
            steps = inner_steps(h, step_s)
            wanted = acting(goal, row, goal[0])
            for _ in range(pieces):
                aim = min(max(wanted, aim - n.goal_rate * h), aim + n.goal_rate * h)
                shown = encoder_position(p, tables, s.position)
                duty, total = servo_duty(n, gain[k], aim, shown, s.velocity, total, h)
                torque = factor[k] * duty - n.emf * s.velocity
                if not on[k]:
                    torque = total = 0.0
                advance(p, tables, s, line, torque, 0.0, steps, h / steps, 0.0, temperature[k])
            now = end
