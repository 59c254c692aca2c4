"""The axis under a recorded torque, as a kernel; and the states that no recording holds, run along the recorded motion.

Used by `servod.models.replay`, which compiles it. The recorded command is held over its sample and acts `delay_s`
later; an interval is cut where the command changes, so that any delay and uneven samples are exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from servod.models.dynamics import advance
from servod.models.effects import (
    actuator,
    dry_factor,
    encoder_position,
    inertia_at,
    joint_spring,
    load_torque,
    nonlinear_viscous,
    resisting_torque,
    ripple,
    thermal_factors,
)
from servod.models.friction import Params, directed_curve
from servod.models.layout import (
    P_DELAY_S,
    P_FRICTION_PER_COMMAND,
    P_FRICTION_PER_LOAD,
    P_INERTIA,
    P_LOAD_INERTIA,
    P_LOAD_VISCOUS,
    P_NEGATIVE_VISCOUS,
    P_OFFSET,
    P_POSITIVE_VISCOUS,
    P_SIGMA0,
    P_VISCOUS,
    S_BRISTLE,
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


def follow(
    p: Params, s: Any, t: Any, motion: Any, torque: Any, before: float, temperature: Any, out: Any, step_s: float
) -> None:
    """Run bristle, load and actuator along the recorded motor motion (rows of position, velocity, acceleration).

    `out` gets bristle, load position, load velocity and actuator torque of each row: with the row's position and
    velocity a complete state, drawn from the recording alone.
    """
    s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = motion[0, 0], motion[0, 1]
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
            _follow_step(p, s, acceleration, temperature[k], span / steps)


def _follow_step(p: Params, s: Any, acceleration: float, temperature_c: float, h: float) -> None:
    """One step of load and bristle under a prescribed motor motion."""
    position, velocity = s[S_POSITION], s[S_VELOCITY]
    load = load_torque(p, s[S_LOAD_POSITION], s[S_TIME_S])
    inertia, slope = inertia_at(p, s[S_LOAD_POSITION])
    carried = load + 0.5 * slope * velocity * velocity
    if p[P_LOAD_INERTIA] > 0.0:
        carried = _follow_load(p, s, load, inertia, slope, h)
        inertia = p[P_INERTIA]
    else:
        s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = position, velocity
    if p[P_SIGMA0] == 0.0:
        return
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    drive = s[S_TORQUE] * ripple(p, position)
    dry = directed_curve(p, velocity) * dry_factor(p, position) * dry_warm
    dry += p[P_FRICTION_PER_COMMAND] * abs(drive) + p[P_FRICTION_PER_LOAD] * abs(load)
    viscous = p[P_VISCOUS] * (p[P_POSITIVE_VISCOUS] if velocity >= 0.0 else p[P_NEGATIVE_VISCOUS])
    viscous = (viscous + nonlinear_viscous(p, velocity)) * viscous_warm
    friction = drive + p[P_OFFSET] - resisting_torque(p, position, velocity, s[S_TIME_S]) - carried
    balance = (friction - inertia * acceleration - viscous * velocity) / p[P_SIGMA0]
    rate = p[P_SIGMA0] * abs(velocity) / dry + BRISTLE_CORRECTION_PER_S
    goal = (velocity + BRISTLE_CORRECTION_PER_S * balance) / rate
    bristle = goal + (s[S_BRISTLE] - goal) * math.exp(-rate * h)
    most = dry / p[P_SIGMA0]
    s[S_BRISTLE] = min(max(bristle, -most), most)


def _follow_load(p: Params, s: Any, load: float, inertia: float, slope: float, h: float) -> float:
    """Step the load behind the spring under the prescribed motor; returns the torque that the motor carries."""
    relative = s[S_VELOCITY] - s[S_LOAD_VELOCITY]
    stretch = s[S_POSITION] - s[S_LOAD_POSITION]
    tau, stiffness, damping = joint_spring(p, stretch, stretch)
    tau += damping * relative
    old = s[S_LOAD_VELOCITY]
    coupling = 0.5 * h * stiffness + damping + p[P_LOAD_VISCOUS]
    push = tau - load - 0.5 * slope * old * old - p[P_LOAD_VISCOUS] * old + 0.5 * h * stiffness * relative
    s[S_LOAD_VELOCITY] = old + h / inertia * push / (1.0 + h / inertia * coupling)
    s[S_LOAD_POSITION] += 0.5 * h * (old + s[S_LOAD_VELOCITY])
    return float(tau)
