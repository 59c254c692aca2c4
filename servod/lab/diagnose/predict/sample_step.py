"""One long step of the axis, second order in time: the physics of `servod.kernels.physics` at a recording's sample
time.

Called by `innovation_kernel`. The simulator's step is first order and takes 50 us; here every effect is taken at
mid-step, so that a millisecond costs no half step of friction, and the bristle by the Pade form of its exponential,
which neither rings nor overshoots at any speed. The effects themselves are the simulator's own functions.
"""

from __future__ import annotations

import math

from servod.kernels.physics.effects import (
    actuator,
    actuator_goal,
    dry_factor,
    inertia_at,
    joint_spring,
    load_torque,
    nonlinear_viscous,
    offset,
    resisting_torque,
    ripple,
)
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables


def step(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    command: float,
    h: float,
    acceleration: float,
    dry: float,
    viscous: float,
    pull: float,
) -> float:
    """Advance `s` by `h` seconds under a command that has arrived; returns the acceleration.

    `acceleration` is the last step's, `dry` and `viscous` are the friction's factors of warmth. `pull` is the speed
    with which an observer carries the model along beside its own: friction is that of both together.
    """
    old = s.velocity
    velocity = old + 0.5 * h * acceleration + pull
    position = s.position + 0.5 * h * old
    load_speed = s.load_velocity
    load_position = s.load_position + 0.5 * h * load_speed
    drive = mean_drive(p, s, command, h) * ripple(p, tables, position)
    load = load_torque(p, tables, load_position, s.time_s + 0.5 * h)
    push = drive + offset(p, s) - resisting_torque(p, tables, position, velocity, s.time_s + 0.5 * h)
    grip = directed_curve(p, tables, velocity) * dry_factor(p, tables, position) * dry
    grip += p.friction_per_command * abs(drive) + p.friction_per_load * abs(load)
    slide = p.viscous * (p.positive_viscous if velocity >= 0.0 else p.negative_viscous)
    if p.complex:
        slide = max(slide + nonlinear_viscous(p, velocity), 0.0)
    slide *= viscous
    inertia, slope = inertia_at(p, tables, load_position)
    if p.load_inertia > 0.0:
        tau, extra, base, share = load_step(p, s, load, inertia, slope, h)
        mean = mid_velocity(p, s, velocity, push - tau, p.inertia, h, grip, slide, extra, pull)
        load_mean = base + share * mean
        s.load_position += h * load_mean
        s.load_velocity = 2.0 * load_mean - load_speed
        s.position += h * mean
    else:
        push -= load + 0.5 * slope * velocity * velocity
        mean = mid_velocity(p, s, velocity, push, inertia, h, grip, slide, 0.0, pull)
        s.position += h * mean
        s.load_position, s.load_velocity = s.position, 2.0 * mean - old
    s.velocity = 2.0 * mean - old
    s.time_s += h
    return 2.0 * (mean - old) / h


def mean_drive(p: PlantParameters, s: PlantState, command: float, h: float) -> float:
    """Mean torque of the actuator over the step, before ripple; its state moves on."""
    if not p.complex:
        return command
    old = s.torque
    new = actuator(p, old, command, h)
    s.torque = new
    if p.slew > 0.0:
        return 0.5 * (old + new)
    return actuator_goal(p, command) + (old - new) * p.lag_s / h


def mid_velocity(
    p: PlantParameters,
    s: PlantState,
    velocity: float,
    torque: float,
    inertia: float,
    h: float,
    grip: float,
    viscous: float,
    extra: float,
    pull: float,
) -> float:
    """Mean velocity of the step under `torque` and friction; `extra` is what the joint's spring adds to `viscous`.

    m*(v1 - v0)/h = torque - F, F the mean friction over the step, linear in the mean velocity once the bristle's rate
    is taken at the expected mid-step `velocity`. Moves the bristle on.
    """
    impulse = 2.0 * inertia / h
    pushed = torque + impulse * s.velocity
    if p.sigma0 == 0.0:
        free = impulse + extra
        mean = sliding_or_held(pushed + free * pull, free + viscous, grip) - pull
        s.friction = pushed - free * mean
        return mean
    speed = abs(velocity)
    damping = bristle_damping(p, velocity)
    y = p.sigma0 * speed * h / grip
    whole = 1.0 + y + 0.5 * y * y
    held = (1.0 + 0.5 * y) / whole  # share of the old deflection in the step's mean
    follow = h * 0.5 * (1.0 + y) / whole  # mean deflection per mean velocity
    kept, gained = 1.0 / whole, h * (1.0 + 0.5 * y) / whole
    bristle = s.bristle
    memory = (p.sigma0 * held + damping * (kept - 1.0) / h) * bristle
    slope = p.sigma0 * follow + damping * gained / h
    memory += (slope + viscous) * pull
    mean = (pushed - memory) / (impulse + slope + viscous + extra)
    s.bristle = kept * bristle + gained * (mean + pull)
    s.friction = memory + (slope + viscous) * mean
    return mean


def sliding_or_held(pushed: float, resist: float, grip: float) -> float:
    """Mean velocity under set-valued Coulomb friction."""
    if abs(pushed) <= grip:
        return 0.0
    return (pushed - math.copysign(grip, pushed)) / resist


def bristle_damping(p: PlantParameters, velocity: float) -> float:
    """sigma1 at this velocity."""
    if p.sigma1_velocity == 0.0:
        return p.sigma1
    ratio = velocity / p.sigma1_velocity
    return p.sigma1 * math.exp(-ratio * ratio)


def load_step(
    p: PlantParameters, s: PlantState, load: float, inertia: float, slope: float, h: float
) -> tuple[float, float, float, float]:
    """Eliminate the load from the step: (torque on the motor, extra viscous of the motor, base, share).

    Implicit midpoint; the load's mean velocity is base + share*(motor's mean velocity).
    """
    speed = s.load_velocity
    stretch = s.position - s.load_position
    tau, stiffness, damping = joint_spring(p, stretch, stretch + 0.5 * h * (s.velocity - speed))
    coupling = 0.5 * h * stiffness + damping
    impulse = 2.0 * inertia / h
    whole = impulse + coupling + p.load_viscous
    base = (impulse * speed + tau - load - 0.5 * slope * speed * speed) / whole
    share = coupling / whole
    return tau - coupling * base, coupling * (1.0 - share), base, share
