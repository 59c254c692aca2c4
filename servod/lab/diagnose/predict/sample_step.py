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
from servod.kernels.physics.friction import Params, directed_curve
from servod.kernels.physics.layout import (
    P_COMPLEX,
    P_FRICTION_PER_COMMAND,
    P_FRICTION_PER_LOAD,
    P_INERTIA,
    P_LAG_S,
    P_LOAD_INERTIA,
    P_LOAD_VISCOUS,
    P_NEGATIVE_VISCOUS,
    P_POSITIVE_VISCOUS,
    P_SIGMA0,
    P_SIGMA1,
    P_SIGMA1_VELOCITY,
    P_SLEW,
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


def step(
    p: Params, s: State, command: float, h: float, acceleration: float, dry: float, viscous: float, pull: float
) -> float:
    """Advance `s` by `h` seconds under a command that has arrived; returns the acceleration.

    `acceleration` is the last step's, `dry` and `viscous` are the friction's factors of warmth. `pull` is the speed
    with which an observer carries the model along beside its own: friction is that of both together.
    """
    old = s[S_VELOCITY]
    velocity = old + 0.5 * h * acceleration + pull
    position = s[S_POSITION] + 0.5 * h * old
    load_speed = s[S_LOAD_VELOCITY]
    load_position = s[S_LOAD_POSITION] + 0.5 * h * load_speed
    drive = mean_drive(p, s, command, h) * ripple(p, position)
    load = load_torque(p, load_position, s[S_TIME_S] + 0.5 * h)
    push = drive + offset(p, s) - resisting_torque(p, position, velocity, s[S_TIME_S] + 0.5 * h)
    grip = directed_curve(p, velocity) * dry_factor(p, position) * dry
    grip += p[P_FRICTION_PER_COMMAND] * abs(drive) + p[P_FRICTION_PER_LOAD] * abs(load)
    slide = p[P_VISCOUS] * (p[P_POSITIVE_VISCOUS] if velocity >= 0.0 else p[P_NEGATIVE_VISCOUS])
    if p[P_COMPLEX] != 0.0:
        slide = max(slide + nonlinear_viscous(p, velocity), 0.0)
    slide *= viscous
    inertia, slope = inertia_at(p, load_position)
    if p[P_LOAD_INERTIA] > 0.0:
        tau, extra, base, share = load_step(p, s, load, inertia, slope, h)
        mean = mid_velocity(p, s, velocity, push - tau, p[P_INERTIA], h, grip, slide, extra, pull)
        load_mean = base + share * mean
        s[S_LOAD_POSITION] += h * load_mean
        s[S_LOAD_VELOCITY] = 2.0 * load_mean - load_speed
        s[S_POSITION] += h * mean
    else:
        push -= load + 0.5 * slope * velocity * velocity
        mean = mid_velocity(p, s, velocity, push, inertia, h, grip, slide, 0.0, pull)
        s[S_POSITION] += h * mean
        s[S_LOAD_POSITION], s[S_LOAD_VELOCITY] = s[S_POSITION], 2.0 * mean - old
    s[S_VELOCITY] = 2.0 * mean - old
    s[S_TIME_S] += h
    return 2.0 * (mean - old) / h


def mean_drive(p: Params, s: State, command: float, h: float) -> float:
    """Mean torque of the actuator over the step, before ripple; its state moves on."""
    if p[P_COMPLEX] == 0.0:
        return command
    old = s[S_TORQUE]
    new = actuator(p, old, command, h)
    s[S_TORQUE] = new
    if p[P_SLEW] > 0.0:
        return 0.5 * (old + new)
    return actuator_goal(p, command) + (old - new) * p[P_LAG_S] / h


def mid_velocity(
    p: Params,
    s: State,
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
    pushed = torque + impulse * s[S_VELOCITY]
    if p[P_SIGMA0] == 0.0:
        free = impulse + extra
        mean = sliding_or_held(pushed + free * pull, free + viscous, grip) - pull
        s[S_FRICTION] = pushed - free * mean
        return mean
    speed = abs(velocity)
    damping = bristle_damping(p, velocity)
    y = p[P_SIGMA0] * speed * h / grip
    whole = 1.0 + y + 0.5 * y * y
    held = (1.0 + 0.5 * y) / whole  # share of the old deflection in the step's mean
    follow = h * 0.5 * (1.0 + y) / whole  # mean deflection per mean velocity
    kept, gained = 1.0 / whole, h * (1.0 + 0.5 * y) / whole
    bristle = s[S_BRISTLE]
    memory = (p[P_SIGMA0] * held + damping * (kept - 1.0) / h) * bristle
    slope = p[P_SIGMA0] * follow + damping * gained / h
    memory += (slope + viscous) * pull
    mean = (pushed - memory) / (impulse + slope + viscous + extra)
    s[S_BRISTLE] = kept * bristle + gained * (mean + pull)
    s[S_FRICTION] = memory + (slope + viscous) * mean
    return mean


def sliding_or_held(pushed: float, resist: float, grip: float) -> float:
    """Mean velocity under set-valued Coulomb friction."""
    if abs(pushed) <= grip:
        return 0.0
    return (pushed - math.copysign(grip, pushed)) / resist


def bristle_damping(p: Params, velocity: float) -> float:
    """sigma1 at this velocity."""
    if p[P_SIGMA1_VELOCITY] == 0.0:
        return p[P_SIGMA1]
    ratio = velocity / p[P_SIGMA1_VELOCITY]
    return p[P_SIGMA1] * math.exp(-ratio * ratio)


def load_step(
    p: Params, s: State, load: float, inertia: float, slope: float, h: float
) -> tuple[float, float, float, float]:
    """Eliminate the load from the step: (torque on the motor, extra viscous of the motor, base, share).

    Implicit midpoint; the load's mean velocity is base + share*(motor's mean velocity).
    """
    speed = s[S_LOAD_VELOCITY]
    stretch = s[S_POSITION] - s[S_LOAD_POSITION]
    tau, stiffness, damping = joint_spring(p, stretch, stretch + 0.5 * h * (s[S_VELOCITY] - speed))
    coupling = 0.5 * h * stiffness + damping
    impulse = 2.0 * inertia / h
    whole = impulse + coupling + p[P_LOAD_VISCOUS]
    base = (impulse * speed + tau - load - 0.5 * slope * speed * speed) / whole
    share = coupling / whole
    return tau - coupling * base, coupling * (1.0 - share), base, share
