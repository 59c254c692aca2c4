"""One-step predictions of a recorded motion, as a kernel: the model under the recorded command, pulled to the encoder.

Compiled by `servod.lab.diagnose.predict.predict`. Between two rows the model runs freely; at each row its motion is
corrected by fixed gains. What is left at a row before the correction is the innovation: noise when the model is right
(Ljung, System Identification, 1999, ch. 7: prediction-error methods).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from servod.kernels.physics.effects import (
    actuator,
    actuator_goal,
    dry_factor,
    encoder_position,
    heat,
    inertia_at,
    joint_spring,
    load_torque,
    nonlinear_viscous,
    offset,
    resisting_torque,
    ripple,
    thermal_factors,
)
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables
from servod.lab.simulate.open_loop import acting, acts_until, begin, switch_row

# --- One step --------------------------------------------------------------------------------------------------------
# One long step of the axis, second order in time: the physics of `servod.kernels.physics` at a recording's sample time.
# The simulator's step is first order and takes 50 us; here every effect is taken at mid-step, so that a millisecond
# costs no half step of friction, and the bristle by the Pade form of its exponential, which neither rings nor
# overshoots at any speed. The effects themselves are the simulator's own functions.


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


def innovate(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    t: Any,
    torque: Sequence[float],
    before: float,
    temperature: Any,
    position: Any,
    steps: Any,
    position_gain: Any,
    velocity_gain: Any,
    load_share: float,
    quiet: float,
    starts: Any,
    start_states: Any,
    out: Any,
) -> None:
    """Fill `out` with recorded minus predicted position of each row.

    `steps` are inner steps from each row to the next; `position_gain` and `velocity_gain` (1/s) the shares of the
    innovation that correct the motion at each row, `load_share` of them for the load. A correction of the position is
    motion to the bristle, else a model that sticks could be held along by its own break-away torque while the joint
    slides; but not where the innovation is within `quiet`, for noise would wear the bristle off. Rows in `starts` begin
    again from the rows of `start_states` (position, velocity, bristle, load position, load velocity, actuator torque).
    """
    window, row, last, acceleration = 0, -1, len(t) - 1, 0.0
    for k in range(len(t)):
        s.time_s = t[k]
        if window < len(starts) and starts[window] == k:
            begin(s, start_states[window])
            window += 1
        off = position[k] - encoder_position(p, tables, s.position)
        out[k] = off
        if k == last:
            break
        correct(s, position_gain[k] * off, velocity_gain[k] * off, load_share)
        now, whole = t[k], t[k + 1] - t[k]
        dry, viscous = thermal_factors(p, s, temperature[k])
        loss = 0.0
        excess = max(abs(off) - quiet, 0.0)
        pull = math.copysign(position_gain[k] * excess / whole, off) if whole > 0.0 else 0.0
        if steps[k] == 1:
            row, command = mean_command(t, torque, before, row, p.delay_s, now, t[k + 1])
            acceleration = step(p, tables, s, command, whole, acceleration, dry, viscous, pull)
            loss, now = s.friction * s.velocity * whole, t[k + 1]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p.delay_s)
            end = acts_until(t, row, p.delay_s, t[k + 1])
            count = max(1, round(steps[k] * (end - now) / whole))
            command, h = acting(torque, row, before), (end - now) / count
            for _ in range(count):
                acceleration = step(p, tables, s, command, h, acceleration, dry, viscous, pull)
                loss += s.friction * s.velocity * h
            now = end
        heat(p, s, loss, whole, temperature[k])


def mean_command(
    t: Any, torque: Sequence[float], before: float, row: int, delay_s: float, now: float, end: float
) -> tuple[int, float]:
    """The row whose command acts last before `end`, and the mean of the commands that act from `now` to `end`.

    One step under the mean costs an order less than the observer shows: (rate*step)^2/8 of a command's change.
    """
    begun, push = now, 0.0
    while now < end:
        row = switch_row(t, row, now, delay_s)
        until = acts_until(t, row, delay_s, end)
        push += acting(torque, row, before) * (until - now)
        now = until
    return row, push / (end - begun)


def correct(s: PlantState, shift: float, push: float, load_share: float) -> None:
    """Correct the motion of the motor, and by `load_share` of it that of the load."""
    s.position += shift
    s.load_position += load_share * shift
    s.velocity += push
    s.load_velocity += load_share * push
