"""The axis as a kernel: torque command in, position out, inner steps of at most 50 us.

Used by the virtual plant (`plant`), the simulator and replay (`simulate`). `advance` is the one entry: the plain joint
(one mass, bristle, gravity, offset, delay, cogging, heat) runs in a tight loop; other effects take the general loop.
"""

from __future__ import annotations

import math

from servod.kernels.physics.effects import (
    actuator,
    delay_steps,
    delayed,
    dry_factor,
    harmonics,
    heat,
    inertia_at,
    load_torque,
    nonlinear_viscous,
    offset,
    resisting_torque,
    ripple,
    spring_step,
    thermal_factors,
)
from servod.kernels.physics.friction import Params, bristle_step, coulomb_step, directed_curve
from servod.kernels.physics.layout import (
    P_COGGING,
    P_COGGING_N,
    P_COMPLEX,
    P_FRICTION_PER_COMMAND,
    P_FRICTION_PER_LOAD,
    P_GRAVITY,
    P_GRAVITY_PHASE,
    P_INERTIA,
    P_LOAD_INERTIA,
    P_NEGATIVE_VISCOUS,
    P_POSITIVE_VISCOUS,
    P_SIGMA0,
    P_SIGMA1,
    P_SIGMA1_VELOCITY,
    P_VISCOUS,
    S_BRISTLE,
    S_FRICTION,
    S_LOAD_POSITION,
    S_LOAD_VELOCITY,
    S_POSITION,
    S_TIME_S,
    S_TORQUE,
    S_VELOCITY,
)

State = list[float]


def advance(
    p: Params, s: State, command: float, external: float, steps: int, h: float, delay_s: float, temperature_c: float
) -> None:
    """Advance the state `s` by `steps` inner steps of `h` seconds under a held torque command.

    `external` is a torque that acts beside the command without delay (noise, load); `delay_s` is command to torque;
    `temperature_c` is the recorded joint temperature, NaN where the model's own heating shall count.
    """
    if p[P_COMPLEX] == 0.0:
        _advance_plain(p, s, command, external, steps, h, delay_s, temperature_c)
    else:
        _advance_general(p, s, command, external, steps, h, delay_s, temperature_c)


def friction_step(
    p: Params, velocity: float, bristle: float, torque: float, inertia: float, h: float, dry: float, viscous: float
) -> tuple[float, float, float]:
    """(v, z, F) after one step under the model's friction law: bristle, or set-valued where it has no stiffness."""
    if p[P_SIGMA0] == 0.0:
        new_velocity, friction = coulomb_step(velocity, torque, inertia, h, dry, viscous)
        return new_velocity, 0.0, friction
    sigma1 = p[P_SIGMA1]
    if p[P_SIGMA1_VELOCITY] > 0.0:
        ratio = velocity / p[P_SIGMA1_VELOCITY]
        sigma1 *= math.exp(-ratio * ratio)
    return bristle_step(velocity, bristle, torque, inertia, h, dry, p[P_SIGMA0], sigma1, viscous)


def _advance_plain(
    p: Params, s: State, command: float, external: float, steps: int, h: float, delay_s: float, temperature_c: float
) -> None:
    position, velocity, bristle, friction = s[S_POSITION], s[S_VELOCITY], s[S_BRISTLE], s[S_FRICTION]
    inertia, gravity, beside = p[P_INERTIA], p[P_GRAVITY], offset(p, s) + external
    cogging, rows = int(p[P_COGGING]), int(p[P_COGGING_N])
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    whole, part = delay_steps(delay_s, h)
    loss = 0.0
    for _ in range(steps):
        torque = delayed(s, command, whole, part) + beside
        if gravity != 0.0:
            torque -= gravity * math.sin(position + p[P_GRAVITY_PHASE])
        if rows > 0:
            torque -= harmonics(p, cogging, rows, position)
        viscous = viscous_warm * p[P_VISCOUS] * (p[P_POSITIVE_VISCOUS] if velocity >= 0.0 else p[P_NEGATIVE_VISCOUS])
        dry = dry_warm * directed_curve(p, velocity)
        old = velocity
        velocity, bristle, friction = friction_step(p, velocity, bristle, torque, inertia, h, dry, viscous)
        position += 0.5 * h * (old + velocity)
        loss += friction * velocity
    s[S_POSITION], s[S_VELOCITY], s[S_BRISTLE], s[S_FRICTION] = position, velocity, bristle, friction
    s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = position, velocity
    s[S_TIME_S] += steps * h
    heat(p, s, loss * h, steps * h, temperature_c)


def _advance_general(
    p: Params, s: State, command: float, external: float, steps: int, h: float, delay_s: float, temperature_c: float
) -> None:
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    whole, part = delay_steps(delay_s, h)
    loss = 0.0
    for _ in range(steps):
        s[S_TORQUE] = actuator(p, s[S_TORQUE], delayed(s, command, whole, part), h)
        _general_step(p, s, external, h, dry_warm, viscous_warm)
        loss += s[S_FRICTION] * s[S_VELOCITY] * h
    heat(p, s, loss, steps * h, temperature_c)


def _general_step(p: Params, s: State, external: float, h: float, dry_warm: float, viscous_warm: float) -> None:
    """One inner step with every effect; one mass or two."""
    position, velocity = s[S_POSITION], s[S_VELOCITY]
    load = load_torque(p, s[S_LOAD_POSITION], s[S_TIME_S]) - external
    drive = s[S_TORQUE] * ripple(p, position)
    torque = drive + offset(p, s) - resisting_torque(p, position, velocity, s[S_TIME_S])
    dry = directed_curve(p, velocity) * dry_factor(p, position) * dry_warm
    dry += p[P_FRICTION_PER_COMMAND] * abs(drive) + p[P_FRICTION_PER_LOAD] * abs(load)
    viscous = p[P_VISCOUS] * (p[P_POSITIVE_VISCOUS] if velocity >= 0.0 else p[P_NEGATIVE_VISCOUS])
    viscous = max(viscous + nonlinear_viscous(p, velocity), 0.0) * viscous_warm
    inertia, slope = inertia_at(p, s[S_LOAD_POSITION])
    if p[P_LOAD_INERTIA] > 0.0:
        tau, extra, base, share = spring_step(p, s, load, inertia, slope, h)
        step = friction_step(p, velocity, s[S_BRISTLE], torque - tau, p[P_INERTIA], h, dry, viscous + extra)
        old_load = s[S_LOAD_VELOCITY]
        s[S_LOAD_VELOCITY] = base + share * step[0]
        s[S_LOAD_POSITION] += 0.5 * h * (old_load + s[S_LOAD_VELOCITY])
    else:
        extra = 0.0
        torque -= load + 0.5 * slope * velocity * velocity
        step = friction_step(p, velocity, s[S_BRISTLE], torque, inertia, h, dry, viscous)
    s[S_VELOCITY], s[S_BRISTLE] = step[0], step[1]
    s[S_FRICTION] = step[2] - extra * step[0]
    s[S_POSITION] += 0.5 * h * (velocity + step[0])
    if p[P_LOAD_INERTIA] == 0.0:
        s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = s[S_POSITION], s[S_VELOCITY]
    s[S_TIME_S] += h
