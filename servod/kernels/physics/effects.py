"""Kernels of the effects beside plain friction; each equation stands in the docstring of its group
(servod.formats.model.effects).

Called by `servod.kernels.physics.dynamics` in every inner step of a model that has such an effect. An absent effect
costs one comparison. Plain functions on floats and numbers by name; the same source is compiled.
"""

from __future__ import annotations

import math
from collections.abc import MutableSequence

from servod.kernels.physics.friction import interpolate
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables

#: Friction factors (temperature, position) never fall below this share: friction cannot vanish or drive.
SMALLEST_FACTOR = 0.05

#: Newton steps for the position behind an eccentric encoder or the stretch of a joint's spring; 4 reach the last digit.
NEWTON_STEPS = 8


def delayed(s: PlantState, line: MutableSequence[float], command: float, whole: int, part: float) -> float:
    """Write `command` into the delay line; the one of `whole + part` inner steps ago, fractions blended."""
    length, head = len(line), s.head
    line[head] = command
    s.head = head + 1 if head + 1 < length else 0
    new = head - whole
    if new < 0:
        new += length
    if part == 0.0:
        return line[new]
    old = new - 1 if new > 0 else length - 1
    return (1.0 - part) * line[new] + part * line[old]


def delay_steps(delay_s: float, h: float) -> tuple[int, float]:
    """A delay as whole inner steps and the part of one that is left (none when it is next to nothing)."""
    whole = int(delay_s / h + 1e-6)
    part = delay_s / h - whole
    return whole, part if part > 1e-6 else 0.0


def harmonics(tables: Tables, start: int, rows: int, x: float) -> float:
    """Sum of amplitude*sin(n*x + phase) over the rows of a table."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total += tables[i] * math.sin(tables[i + 1] * x + tables[i + 2])
    return total


def harmonics_slope(tables: Tables, start: int, rows: int, x: float) -> float:
    """Derivative of `harmonics` by x."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total += tables[i] * tables[i + 1] * math.cos(tables[i + 1] * x + tables[i + 2])
    return total


def harmonics_curvature(tables: Tables, start: int, rows: int, x: float) -> float:
    """Second derivative of `harmonics` by x."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total -= tables[i] * tables[i + 1] * tables[i + 1] * math.sin(tables[i + 1] * x + tables[i + 2])
    return total


def encoder_position(p: PlantParameters, tables: Tables, x: float) -> float:
    """What an ideal-resolution encoder shows at position `x`: eccentricity added."""
    return x + harmonics(tables, p.eccentricity, p.eccentricity_n, x)


def behind_encoder(
    p: PlantParameters, tables: Tables, shown: float, rate: float, rate_of_rate: float
) -> tuple[float, float, float]:
    """True position, velocity, acceleration behind what the encoder shows: `encoder_position` inverted by Newton.

    The model checks that the encoder's slope is positive everywhere, so that there is one answer.
    """
    start, rows = p.eccentricity, p.eccentricity_n
    if rows == 0:
        return shown, rate, rate_of_rate
    x = shown
    for _ in range(NEWTON_STEPS):
        x -= (x + harmonics(tables, start, rows, x) - shown) / (1.0 + harmonics_slope(tables, start, rows, x))
    slope = 1.0 + harmonics_slope(tables, start, rows, x)
    velocity = rate / slope
    return x, velocity, (rate_of_rate - harmonics_curvature(tables, start, rows, x) * velocity * velocity) / slope


def actuator(p: PlantParameters, torque: float, command: float, h: float) -> float:
    """Torque behind gain, limit, lag and slew rate, one step of `h` s after it was `torque`; the lag is exact."""
    goal = actuator_goal(p, command)
    if p.lag_s > 0.0:
        goal = torque + (goal - torque) * (1.0 - math.exp(-h / p.lag_s))
    if p.slew > 0.0:
        reach = p.slew * h
        goal = min(max(goal, torque - reach), torque + reach)
    return goal


def actuator_goal(p: PlantParameters, command: float) -> float:
    """The torque that a command leads to when it is held: gain, then limit."""
    goal = command * (p.gain_positive if command >= 0.0 else p.gain_negative)
    return limited(p, goal) if p.limit_positive > 0.0 else goal


def limited(p: PlantParameters, torque: float) -> float:
    """The torque behind the drive's limit, hard or tanh."""
    limit = p.limit_positive if torque >= 0.0 else p.limit_negative
    if p.limit_soft:
        return limit * math.tanh(torque / limit)
    return min(max(torque, -limit), limit)


def ripple(p: PlantParameters, tables: Tables, x: float) -> float:
    """Factor of torque ripple at position `x`."""
    if p.ripple_n == 0:
        return 1.0
    return 1.0 + harmonics(tables, p.ripple, p.ripple_n, x)


def offset(p: PlantParameters, s: PlantState) -> float:
    """Constant torque beside the command, with what it has drifted since the first step."""
    if p.offset_per_s == 0.0:
        return p.offset
    return p.offset + p.offset_per_s * drifted(s, p.offset_time_s)


def drifted(s: PlantState, limit_s: float) -> float:
    """Time since the first step, s; of a drift that ends (`limit_s` above 0), the time it would take without an end."""
    time_s = s.time_s - s.first_s
    return time_s if limit_s == 0.0 else limit_s * (1.0 - math.exp(-time_s / limit_s))


def resisting_torque(p: PlantParameters, tables: Tables, x: float, velocity: float, time_s: float) -> float:
    """Cogging and the tables of unexplained torque: what resists on the motor side besides friction."""
    torque = 0.0
    if p.cogging_n > 0:
        torque += harmonics(tables, p.cogging, p.cogging_n, x)
    if p.residual_position_n > 0:
        torque += interpolate(tables, p.residual_position, p.residual_position_n, x, False)
    if p.residual_velocity_n > 0:
        torque += interpolate(tables, p.residual_velocity, p.residual_velocity_n, velocity, False)
    if p.residual_time_n > 0:
        torque += interpolate(tables, p.residual_time, p.residual_time_n, time_s, False)
    return torque


def load_torque(p: PlantParameters, tables: Tables, x: float, time_s: float) -> float:
    """Gravity, spring and disturbance: what resists on the load side."""
    torque = p.gravity * math.sin(x + p.gravity_phase) if p.gravity != 0.0 else 0.0
    if p.spring != 0.0 or p.spring_cubic != 0.0:
        stretch = x - p.spring_rest
        torque += (p.spring + p.spring_cubic * stretch * stretch) * stretch
    for row in range(p.disturbance_n):
        i = p.disturbance + 5 * row
        if tables[i] <= time_s < tables[i + 1]:
            torque -= tables[i + 2] * math.cos(2.0 * math.pi * tables[i + 3] * (time_s - tables[i]) + tables[i + 4])
    return torque


def dry_factor(p: PlantParameters, tables: Tables, x: float) -> float:
    """Factor of dry friction over position."""
    factor = 1.0
    if p.position_friction_n > 0:
        factor += harmonics(tables, p.position_friction, p.position_friction_n, x)
    for row in range(p.bumps_n):
        i = p.bumps + 3 * row
        away = (x - tables[i]) / tables[i + 1]
        factor += tables[i + 2] * math.exp(-0.5 * away * away)
    return max(factor, SMALLEST_FACTOR)


def nonlinear_viscous(p: PlantParameters, velocity: float) -> float:
    """Viscous coefficient to add at this velocity, so that coefficient*v is the group's torque."""
    speed = abs(velocity)
    coefficient = (p.quadratic + p.cubic * speed) * speed
    if p.power != 0.0 and speed > 1e-9:
        coefficient += p.power * speed ** (p.power_exponent - 1.0)
    return coefficient


def inertia_at(p: PlantParameters, tables: Tables, x: float) -> tuple[float, float]:
    """Inertia of the load side (of the whole axis when there is one mass) and its derivative by position."""
    inertia = p.load_inertia if p.load_inertia > 0.0 else p.inertia
    rows = p.position_inertia_n
    if rows == 0:
        return inertia, 0.0
    start = p.position_inertia
    return inertia * (1.0 + harmonics(tables, start, rows, x)), inertia * harmonics_slope(tables, start, rows, x)


def joint_spring(p: PlantParameters, stretch: float, ahead: float) -> tuple[float, float, float]:
    """Torque, slope and damping of the joint's spring; `ahead`: stretch expected at mid-step, decides contact."""
    half = 0.5 * p.gap
    if abs(ahead) < half:
        return 0.0, 0.0, 0.0
    into = stretch - math.copysign(half, ahead)
    bent = p.stiffness_cubic * into * into
    return (p.stiffness + bent) * into, p.stiffness + 3.0 * bent, p.damping


def static_stretch(p: PlantParameters, torque: float) -> float:
    """Stretch x_motor - x_load under which the joint's spring carries `torque`: the load rests on that side of a gap.

    Newton from the line's answer, which lies beyond the stiffening spring's, so that every step comes closer.
    """
    if torque == 0.0:
        return 0.0
    into = torque / p.stiffness
    for _ in range(NEWTON_STEPS):
        bent = p.stiffness_cubic * into * into
        into -= ((p.stiffness + bent) * into - torque) / (p.stiffness + 3.0 * bent)
    return into + math.copysign(0.5 * p.gap, torque)


def spring_step(
    p: PlantParameters, s: PlantState, load: float, inertia: float, slope: float, h: float
) -> tuple[float, float, float, float]:
    """Eliminate the load from one step: (torque on the motor, extra viscous of the motor, base, share).

    The joint's spring is taken at mid-step (no numerical damping), its damper and the load's friction implicitly. The
    load's new velocity is base + share*v_motor, so that the motor's friction step stays a scalar equation.
    """
    relative = s.velocity - s.load_velocity
    stretch = s.position - s.load_position
    tau, stiffness, damping = joint_spring(p, stretch, stretch + 0.5 * h * relative)
    tau += 0.25 * h * stiffness * relative
    coupling = 0.25 * h * stiffness + damping
    gain = h / inertia
    speed = s.load_velocity
    whole = 1.0 + gain * (p.load_viscous + coupling)
    base = (speed + gain * (tau - load - 0.5 * slope * speed * speed)) / whole
    share = gain * coupling / whole
    return tau - coupling * base, coupling * (1.0 - share), base, share


def thermal_factors(p: PlantParameters, s: PlantState, temperature_c: float) -> tuple[float, float]:
    """Factors of dry and viscous friction at the recorded temperature, or the model's own where that is NaN."""
    if not p.thermal:
        return 1.0, 1.0
    warm = s.temperature_c if math.isnan(temperature_c) else temperature_c
    above, drift = warm - p.reference_c, drifted(s, p.drift_time_s)
    dry, viscous = p.dry_per_c * above, p.viscous_per_c * above
    if p.thermal_exponential:
        dry, viscous = math.exp(dry) - 1.0, math.exp(viscous) - 1.0
    dry += 1.0 + p.dry_per_s * drift
    viscous += 1.0 + p.viscous_per_s * drift
    return max(dry, SMALLEST_FACTOR), max(viscous, SMALLEST_FACTOR)


def heat(p: PlantParameters, s: PlantState, loss_j: float, duration_s: float, temperature_c: float) -> None:
    """Warm the joint by the friction loss of the last steps and let it cool; a recorded temperature wins."""
    if not p.thermal:
        return
    if not math.isnan(temperature_c):
        s.temperature_c = temperature_c
        return
    cooled = (s.temperature_c - p.ambient_c) * math.exp(-duration_s / p.cooling_s)
    s.temperature_c = p.ambient_c + cooled + p.heating_c_per_j * loss_j
