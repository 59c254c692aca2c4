"""The axis as a kernel: torque command in, position out, inner steps of at most 50 us.

Used by the virtual plant (`plant`), the simulator and replay (`simulate`). `advance` is the one entry: the plain joint
(one mass, bristle, gravity, offset, delay, cogging, heat) runs in a tight loop; other effects take the general loop.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence

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
from servod.kernels.physics.friction import bristle_step, coulomb_step, directed_curve
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables


def advance(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: MutableSequence[float],
    command: float,
    external: float,
    steps: int,
    h: float,
    delay_s: float,
    temperature_c: float,
) -> None:
    """Advance the state `s` by `steps` inner steps of `h` seconds under a held torque command.

    `external` is a torque that acts beside the command without delay (noise, load); `delay_s` is command to torque;
    `temperature_c` is the recorded joint temperature, NaN where the model's own heating shall count.
    """
    if not p.complex:
        _advance_plain(p, tables, s, line, command, external, steps, h, delay_s, temperature_c)
    else:
        _advance_general(p, tables, s, line, command, external, steps, h, delay_s, temperature_c)


def friction_step(
    p: PlantParameters,
    velocity: float,
    bristle: float,
    torque: float,
    inertia: float,
    h: float,
    dry: float,
    viscous: float,
) -> tuple[float, float, float]:
    """(v, z, F) after one step under the model's friction law: bristle, or set-valued where it has no stiffness."""
    if p.sigma0 == 0.0:
        new_velocity, friction = coulomb_step(velocity, torque, inertia, h, dry, viscous)
        return new_velocity, 0.0, friction
    sigma1 = p.sigma1
    if p.sigma1_velocity > 0.0:
        ratio = velocity / p.sigma1_velocity
        sigma1 *= math.exp(-ratio * ratio)
    return bristle_step(velocity, bristle, torque, inertia, h, dry, p.sigma0, sigma1, viscous)


def _advance_plain(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: MutableSequence[float],
    command: float,
    external: float,
    steps: int,
    h: float,
    delay_s: float,
    temperature_c: float,
) -> None:
    position, velocity, bristle, friction = s.position, s.velocity, s.bristle, s.friction
    inertia, gravity, beside = p.inertia, p.gravity, offset(p, s) + external
    cogging, rows = p.cogging, p.cogging_n
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    whole, part = delay_steps(delay_s, h)
    loss = 0.0
    for _ in range(steps):
        torque = delayed(s, line, command, whole, part) + beside
        if gravity != 0.0:
            torque -= gravity * math.sin(position + p.gravity_phase)
        if rows > 0:
            torque -= harmonics(tables, cogging, rows, position)
        viscous = viscous_warm * p.viscous * (p.positive_viscous if velocity >= 0.0 else p.negative_viscous)
        dry = dry_warm * directed_curve(p, tables, velocity)
        old = velocity
        velocity, bristle, friction = friction_step(p, velocity, bristle, torque, inertia, h, dry, viscous)
        position += 0.5 * h * (old + velocity)
        loss += friction * velocity
    s.position, s.velocity, s.bristle, s.friction = position, velocity, bristle, friction
    s.load_position, s.load_velocity = position, velocity
    s.time_s += steps * h
    heat(p, s, loss * h, steps * h, temperature_c)


def _advance_general(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: MutableSequence[float],
    command: float,
    external: float,
    steps: int,
    h: float,
    delay_s: float,
    temperature_c: float,
) -> None:
    dry_warm, viscous_warm = thermal_factors(p, s, temperature_c)
    whole, part = delay_steps(delay_s, h)
    loss = 0.0
    for _ in range(steps):
        s.torque = actuator(p, s.torque, delayed(s, line, command, whole, part), h)
        _general_step(p, tables, s, external, h, dry_warm, viscous_warm)
        loss += s.friction * s.velocity * h
    heat(p, s, loss, steps * h, temperature_c)


def _general_step(
    p: PlantParameters, tables: Tables, s: PlantState, external: float, h: float, dry_warm: float, viscous_warm: float
) -> None:
    """One inner step with every effect; one mass or two."""
    position, velocity = s.position, s.velocity
    load = load_torque(p, tables, s.load_position, s.time_s) - external
    drive = s.torque * ripple(p, tables, position)
    torque = drive + offset(p, s) - resisting_torque(p, tables, position, velocity, s.time_s)
    dry = directed_curve(p, tables, velocity) * dry_factor(p, tables, position) * dry_warm
    dry += p.friction_per_command * abs(drive) + p.friction_per_load * abs(load)
    viscous = p.viscous * (p.positive_viscous if velocity >= 0.0 else p.negative_viscous)
    viscous = max(viscous + nonlinear_viscous(p, velocity), 0.0) * viscous_warm
    inertia, slope = inertia_at(p, tables, s.load_position)
    if p.load_inertia > 0.0:
        tau, extra, base, share = spring_step(p, s, load, inertia, slope, h)
        step = friction_step(p, velocity, s.bristle, torque - tau, p.inertia, h, dry, viscous + extra)
        old_load = s.load_velocity
        s.load_velocity = base + share * step[0]
        s.load_position += 0.5 * h * (old_load + s.load_velocity)
    else:
        extra = 0.0
        torque -= load + 0.5 * slope * velocity * velocity
        step = friction_step(p, velocity, s.bristle, torque, inertia, h, dry, viscous)
    s.velocity, s.bristle = step[0], step[1]
    s.friction = step[2] - extra * step[0]
    s.position += 0.5 * h * (velocity + step[0])
    if p.load_inertia == 0.0:
        s.load_position, s.load_velocity = s.position, s.velocity
    s.time_s += h
