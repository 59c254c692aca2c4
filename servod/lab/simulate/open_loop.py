"""The axis under a recorded torque, as a kernel; and the states that no recording holds, run along the recorded motion.

Used by `servod.lab.simulate.replay`, which compiles it. The recorded command is held over its sample and acts `delay_s`
later; an interval is cut where the command changes, so that any delay and uneven samples are exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from servod.kernels.physics.dynamics import advance
from servod.kernels.physics.effects import (
    NEWTON_STEPS,
    actuator,
    actuator_goal,
    behind_encoder,
    dry_factor,
    encoder_position,
    inertia_at,
    joint_spring,
    load_torque,
    nonlinear_viscous,
    offset,
    resisting_torque,
    ripple,
    static_stretch,
    thermal_factors,
)
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables

#: Switching instants closer together than this are one, s: clocks of recorders jitter by less.
SAME_INSTANT_S = 1e-6

#: How fast the bristle estimate follows the torque balance, 1/s: slow against noise, fast against a rest of 0.1 s.
BRISTLE_CORRECTION_PER_S = 100.0


def inner_steps(duration_s: float, step_s: float) -> int:
    """Inner steps for a span; one per cent over the length is let pass, so that clock jitter costs no extra step."""
    return max(1, math.ceil(duration_s / step_s - 0.01))


def switch_row(t: Any, row: int, now: float, delay_s: float) -> int:
    """The row whose command acts at `now`, searched upward from `row`."""
    while row + 1 < len(t) and t[row + 1] + delay_s <= now + SAME_INSTANT_S:
        row += 1
    return row


def acting(torque: Sequence[float], row: int, before: float) -> float:
    """The command of `row`; `before` where no recorded command has arrived yet."""
    return before if row < 0 else torque[row]


def acts_until(t: Any, row: int, delay_s: float, limit: float) -> float:
    """When the command of `row` stops acting, at most `limit`."""
    if row + 1 >= len(t):
        return limit
    end = t[row + 1] + delay_s
    return limit if end > limit - SAME_INSTANT_S else end


def run(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: Any,
    t: Any,
    torque: Any,
    before: float,
    temperature: Any,
    starts: Any,
    start_states: Any,
    out: Any,
    step_s: float,
) -> None:
    """Simulate over the rows of `t`; at the rows in `starts` the motion restarts from the rows of `start_states`.

    `start_states` has position, velocity, bristle, load position, load velocity, actuator torque. `out` gets encoder
    position, velocity, load position of each row. `before` is the command that acts until the
    first recorded one arrives; `temperature` is NaN where it was not recorded.
    """
    window, row = 0, -1
    for k in range(len(t)):
        s.time_s = t[k]
        if window < len(starts) and starts[window] == k:
            begin(s, start_states[window])
            window += 1
        out[k, 0], out[k, 1] = encoder_position(p, tables, s.position), s.velocity
        out[k, 2] = s.load_position
        if k + 1 == len(t):
            break
        now = t[k]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p.delay_s)
            end = acts_until(t, row, p.delay_s, t[k + 1])
            steps = inner_steps(end - now, step_s)
            advance(
                p, tables, s, line, acting(torque, row, before), 0.0, steps, (end - now) / steps, 0.0, temperature[k]
            )
            now = end


def begin(s: PlantState, start: Any) -> None:
    """Put the axis into the start state of a window."""
    s.position, s.velocity, s.bristle = start[0], start[1], start[2]
    s.load_position, s.load_velocity, s.torque = start[3], start[4], start[5]


def recorded_motion(p: PlantParameters, tables: Tables, s: PlantState, motion: Any) -> None:
    """Turn rows of position, velocity, acceleration as the encoder showed them into the true ones, in place."""
    for k in range(len(motion)):
        motion[k, 0], motion[k, 1], motion[k, 2] = behind_encoder(p, tables, motion[k, 0], motion[k, 1], motion[k, 2])


def follow(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    t: Any,
    motion: Any,
    torque: Any,
    before: float,
    temperature: Any,
    out: Any,
    step_s: float,
) -> None:
    """Run bristle, load and actuator along the true motor motion (rows of position, velocity, acceleration).

    `out` gets bristle, load position, load velocity and actuator torque of each row: with the row's position and
    velocity a complete state, drawn from the recording alone.
    """
    _settle(p, tables, s, motion, before, t[0], temperature[0])
    row = -1
    for k in range(len(t)):
        s.time_s = t[k]
        if not math.isnan(temperature[k]):
            s.temperature_c = temperature[k]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = s.bristle, s.load_position, s.load_velocity, s.torque
        if k + 1 == len(t):
            break
        now = t[k]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p.delay_s)
            end = acts_until(t, row, p.delay_s, t[k + 1])
            s.torque = actuator(p, s.torque, acting(torque, row, before), end - now)
            now = end
        span = t[k + 1] - t[k]
        steps = inner_steps(span, step_s)
        for i in range(steps):
            share = (i + 0.5) / steps
            s.velocity = motion[k, 1] + share * (motion[k + 1, 1] - motion[k, 1])
            s.position = motion[k, 0] + share * (motion[k + 1, 0] - motion[k, 0])
            acceleration = motion[k, 2] + share * (motion[k + 1, 2] - motion[k, 2])
            carried = _follow_load(p, tables, s, acceleration, span / steps)
            _follow_bristle(p, tables, s, carried, temperature[k], span / steps)


def _settle(
    p: PlantParameters, tables: Tables, s: PlantState, motion: Any, before: float, time_s: float, temperature_c: float
) -> None:
    """The hidden state at the first row: in balance with the row's motion, as if that had lasted for long."""
    s.time_s = s.first_s = time_s
    s.position, s.velocity = motion[0, 0], motion[0, 1]
    s.load_position, s.load_velocity = motion[0, 0], motion[0, 1]
    s.torque = actuator_goal(p, before)
    carried = _carried(p, tables, s, motion[0, 2])
    if p.load_inertia > 0.0:
        for _ in range(NEWTON_STEPS):  # a fixed point: the load's torque changes little over the stretch
            s.load_position = s.position - static_stretch(p, carried)
            carried = _carried(p, tables, s, motion[0, 2])
        carried += p.inertia * motion[0, 2]
    dry, viscous = _friction(p, tables, s, temperature_c)
    stiff = p.sigma0 if p.sigma0 > 0.0 else math.inf
    if p.lag_s > 0.0 and s.velocity != 0.0 and abs(s.velocity) * stiff > dry * BRISTLE_CORRECTION_PER_S:
        beside = resisting_torque(p, tables, s.position, s.velocity, time_s) - offset(p, s)
        s.torque = carried + beside + math.copysign(dry, s.velocity) + viscous * s.velocity
        s.torque /= ripple(p, tables, s.position)
    _follow_bristle(p, tables, s, carried, temperature_c, math.inf)


def _carried(p: PlantParameters, tables: Tables, s: PlantState, acceleration: float) -> float:
    """Torque that moves the load side (the whole axis when there is one mass) with this acceleration."""
    inertia, slope = inertia_at(p, tables, s.load_position)
    speed = s.load_velocity
    moved = inertia * acceleration + 0.5 * slope * speed * speed + p.load_viscous * speed
    return float(load_torque(p, tables, s.load_position, s.time_s) + moved)


def _follow_load(p: PlantParameters, tables: Tables, s: PlantState, acceleration: float, h: float) -> float:
    """Step the load under the prescribed motor; returns what the motor's torque moves besides cogging and friction."""
    if p.load_inertia == 0.0:
        s.load_position, s.load_velocity = s.position, s.velocity
        return _carried(p, tables, s, acceleration)
    inertia, slope = inertia_at(p, tables, s.load_position)
    load = load_torque(p, tables, s.load_position, s.time_s)
    relative = s.velocity - s.load_velocity
    stretch = s.position - s.load_position
    tau, stiffness, damping = joint_spring(p, stretch, stretch)
    tau += damping * relative
    old = s.load_velocity
    coupling = 0.5 * h * stiffness + damping + p.load_viscous
    push = tau - load - 0.5 * slope * old * old - p.load_viscous * old + 0.5 * h * stiffness * relative
    s.load_velocity = old + h / inertia * push / (1.0 + h / inertia * coupling)
    s.load_position += 0.5 * h * (old + s.load_velocity)
    return float(tau + p.inertia * acceleration)


def _friction(p: PlantParameters, tables: Tables, s: PlantState, temperature_c: float) -> tuple[float, float]:
    """Dry friction and viscous coefficient of the state, as `servod.kernels.physics.dynamics` has them."""
    position, velocity = s.position, s.velocity
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    load = load_torque(p, tables, s.load_position, s.time_s)
    dry = directed_curve(p, tables, velocity) * dry_factor(p, tables, position) * dry_warm
    dry += p.friction_per_command * abs(s.torque * ripple(p, tables, position)) + p.friction_per_load * abs(load)
    viscous = p.viscous * (p.positive_viscous if velocity >= 0.0 else p.negative_viscous)
    return dry, max(viscous + nonlinear_viscous(p, velocity), 0.0) * viscous_warm


def _follow_bristle(
    p: PlantParameters, tables: Tables, s: PlantState, carried: float, temperature_c: float, h: float
) -> None:
    """Step the bristle: it follows the motion, and slowly what the torque balance leaves for it."""
    if p.sigma0 == 0.0:
        return
    position, velocity = s.position, s.velocity
    dry, viscous = _friction(p, tables, s, temperature_c)
    drive = s.torque * ripple(p, tables, position)
    friction = drive + offset(p, s) - resisting_torque(p, tables, position, velocity, s.time_s) - carried
    balance = (friction - viscous * velocity) / p.sigma0
    rate = p.sigma0 * abs(velocity) / dry + BRISTLE_CORRECTION_PER_S
    goal = (velocity + BRISTLE_CORRECTION_PER_S * balance) / rate
    bristle = goal + (s.bristle - goal) * math.exp(-rate * h)
    most = dry / p.sigma0
    s.bristle = min(max(bristle, -most), most)
