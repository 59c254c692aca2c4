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
from servod.kernels.physics.friction import Params, directed_curve
from servod.kernels.physics.layout import (
    P_DELAY_S,
    P_FRICTION_PER_COMMAND,
    P_FRICTION_PER_LOAD,
    P_INERTIA,
    P_LAG_S,
    P_LOAD_INERTIA,
    P_LOAD_VISCOUS,
    P_NEGATIVE_VISCOUS,
    P_POSITIVE_VISCOUS,
    P_SIGMA0,
    P_VISCOUS,
    S_BRISTLE,
    S_FIRST_S,
    S_LOAD_POSITION,
    S_LOAD_VELOCITY,
    S_POSITION,
    S_TEMPERATURE_C,
    S_TIME_S,
    S_TORQUE,
    S_VELOCITY,
)

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


def piece_end(t: Any, row: int, delay_s: float, limit: float) -> float:
    """When the command of `row` stops acting, at most `limit`."""
    if row + 1 >= len(t):
        return limit
    end = t[row + 1] + delay_s
    return limit if end > limit - SAME_INSTANT_S else end


def run(
    p: Params,
    s: Any,
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
        s[S_TIME_S] = t[k]
        if window < len(starts) and starts[window] == k:
            begin(s, start_states[window])
            window += 1
        out[k, 0], out[k, 1] = encoder_position(p, s[S_POSITION]), s[S_VELOCITY]
        out[k, 2] = s[S_LOAD_POSITION]
        if k + 1 == len(t):
            break
        now = t[k]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p[P_DELAY_S])
            end = piece_end(t, row, p[P_DELAY_S], t[k + 1])
            steps = inner_steps(end - now, step_s)
            advance(p, s, acting(torque, row, before), 0.0, steps, (end - now) / steps, 0.0, temperature[k])
            now = end


def begin(s: Any, start: Any) -> None:
    """Put the axis into the start state of a window."""
    s[S_POSITION], s[S_VELOCITY], s[S_BRISTLE] = start[0], start[1], start[2]
    s[S_LOAD_POSITION], s[S_LOAD_VELOCITY], s[S_TORQUE] = start[3], start[4], start[5]


def recorded_motion(p: Params, motion: Any) -> None:
    """Turn rows of position, velocity, acceleration as the encoder showed them into the true ones, in place."""
    for k in range(len(motion)):
        motion[k, 0], motion[k, 1], motion[k, 2] = behind_encoder(p, motion[k, 0], motion[k, 1], motion[k, 2])


def follow(
    p: Params, s: Any, t: Any, motion: Any, torque: Any, before: float, temperature: Any, out: Any, step_s: float
) -> None:
    """Run bristle, load and actuator along the true motor motion (rows of position, velocity, acceleration).

    `out` gets bristle, load position, load velocity and actuator torque of each row: with the row's position and
    velocity a complete state, drawn from the recording alone.
    """
    _settle(p, s, motion, before, t[0], temperature[0])
    row = -1
    for k in range(len(t)):
        s[S_TIME_S] = t[k]
        if not math.isnan(temperature[k]):
            s[S_TEMPERATURE_C] = temperature[k]
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = s[S_BRISTLE], s[S_LOAD_POSITION], s[S_LOAD_VELOCITY], s[S_TORQUE]
        if k + 1 == len(t):
            break
        now = t[k]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p[P_DELAY_S])
            end = piece_end(t, row, p[P_DELAY_S], t[k + 1])
            s[S_TORQUE] = actuator(p, s[S_TORQUE], acting(torque, row, before), end - now)
            now = end
        span = t[k + 1] - t[k]
        steps = inner_steps(span, step_s)
        for i in range(steps):
            share = (i + 0.5) / steps
            s[S_VELOCITY] = motion[k, 1] + share * (motion[k + 1, 1] - motion[k, 1])
            s[S_POSITION] = motion[k, 0] + share * (motion[k + 1, 0] - motion[k, 0])
            acceleration = motion[k, 2] + share * (motion[k + 1, 2] - motion[k, 2])
            carried = _follow_load(p, s, acceleration, span / steps)
            _follow_bristle(p, s, carried, temperature[k], span / steps)


def _settle(p: Params, s: Any, motion: Any, before: float, time_s: float, temperature_c: float) -> None:
    """The hidden state at the first row: in balance with the row's motion, as if that had lasted for long."""
    s[S_TIME_S] = s[S_FIRST_S] = time_s
    s[S_POSITION], s[S_VELOCITY] = motion[0, 0], motion[0, 1]
    s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = motion[0, 0], motion[0, 1]
    s[S_TORQUE] = actuator_goal(p, before)
    carried = _carried(p, s, motion[0, 2])
    if p[P_LOAD_INERTIA] > 0.0:
        for _ in range(NEWTON_STEPS):  # a fixed point: the load's torque changes little over the stretch
            s[S_LOAD_POSITION] = s[S_POSITION] - static_stretch(p, carried)
            carried = _carried(p, s, motion[0, 2])
        carried += p[P_INERTIA] * motion[0, 2]
    dry, viscous = _friction(p, s, temperature_c)
    stiff = p[P_SIGMA0] if p[P_SIGMA0] > 0.0 else math.inf
    if p[P_LAG_S] > 0.0 and s[S_VELOCITY] != 0.0 and abs(s[S_VELOCITY]) * stiff > dry * BRISTLE_CORRECTION_PER_S:
        beside = resisting_torque(p, s[S_POSITION], s[S_VELOCITY], time_s) - offset(p, s)
        s[S_TORQUE] = carried + beside + math.copysign(dry, s[S_VELOCITY]) + viscous * s[S_VELOCITY]
        s[S_TORQUE] /= ripple(p, s[S_POSITION])
    _follow_bristle(p, s, carried, temperature_c, math.inf)


def _carried(p: Params, s: Any, acceleration: float) -> float:
    """Torque that moves the load side (the whole axis when there is one mass) with this acceleration."""
    inertia, slope = inertia_at(p, s[S_LOAD_POSITION])
    speed = s[S_LOAD_VELOCITY]
    moved = inertia * acceleration + 0.5 * slope * speed * speed + p[P_LOAD_VISCOUS] * speed
    return float(load_torque(p, s[S_LOAD_POSITION], s[S_TIME_S]) + moved)


def _follow_load(p: Params, s: Any, acceleration: float, h: float) -> float:
    """Step the load under the prescribed motor; returns what the motor's torque moves besides cogging and friction."""
    if p[P_LOAD_INERTIA] == 0.0:
        s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = s[S_POSITION], s[S_VELOCITY]
        return _carried(p, s, acceleration)
    inertia, slope = inertia_at(p, s[S_LOAD_POSITION])
    load = load_torque(p, s[S_LOAD_POSITION], s[S_TIME_S])
    relative = s[S_VELOCITY] - s[S_LOAD_VELOCITY]
    stretch = s[S_POSITION] - s[S_LOAD_POSITION]
    tau, stiffness, damping = joint_spring(p, stretch, stretch)
    tau += damping * relative
    old = s[S_LOAD_VELOCITY]
    coupling = 0.5 * h * stiffness + damping + p[P_LOAD_VISCOUS]
    push = tau - load - 0.5 * slope * old * old - p[P_LOAD_VISCOUS] * old + 0.5 * h * stiffness * relative
    s[S_LOAD_VELOCITY] = old + h / inertia * push / (1.0 + h / inertia * coupling)
    s[S_LOAD_POSITION] += 0.5 * h * (old + s[S_LOAD_VELOCITY])
    return float(tau + p[P_INERTIA] * acceleration)


def _friction(p: Params, s: Any, temperature_c: float) -> tuple[float, float]:
    """Dry friction and viscous coefficient of the state, as `servod.kernels.physics.dynamics` has them."""
    position, velocity = s[S_POSITION], s[S_VELOCITY]
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    load = load_torque(p, s[S_LOAD_POSITION], s[S_TIME_S])
    dry = directed_curve(p, velocity) * dry_factor(p, position) * dry_warm
    dry += p[P_FRICTION_PER_COMMAND] * abs(s[S_TORQUE] * ripple(p, position)) + p[P_FRICTION_PER_LOAD] * abs(load)
    viscous = p[P_VISCOUS] * (p[P_POSITIVE_VISCOUS] if velocity >= 0.0 else p[P_NEGATIVE_VISCOUS])
    return dry, max(viscous + nonlinear_viscous(p, velocity), 0.0) * viscous_warm


def _follow_bristle(p: Params, s: Any, carried: float, temperature_c: float, h: float) -> None:
    """Step the bristle: it follows the motion, and slowly what the torque balance leaves for it."""
    if p[P_SIGMA0] == 0.0:
        return
    position, velocity = s[S_POSITION], s[S_VELOCITY]
    dry, viscous = _friction(p, s, temperature_c)
    drive = s[S_TORQUE] * ripple(p, position)
    friction = drive + offset(p, s) - resisting_torque(p, position, velocity, s[S_TIME_S]) - carried
    balance = (friction - viscous * velocity) / p[P_SIGMA0]
    rate = p[P_SIGMA0] * abs(velocity) / dry + BRISTLE_CORRECTION_PER_S
    goal = (velocity + BRISTLE_CORRECTION_PER_S * balance) / rate
    bristle = goal + (s[S_BRISTLE] - goal) * math.exp(-rate * h)
    most = dry / p[P_SIGMA0]
    s[S_BRISTLE] = min(max(bristle, -most), most)
