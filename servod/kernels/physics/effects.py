"""Kernels of the effects beside plain friction; each equation stands in the docstring of its group in `axis_effects`.

Called by `servod.kernels.physics.dynamics` in every inner step of a model that has such an effect. An absent effect
costs one comparison. Plain functions on floats and flat parameters; the same source is compiled.
"""

from __future__ import annotations

import math

from servod.kernels.physics import layout as lay
from servod.kernels.physics.friction import Params, interpolate

State = list[float]

#: Friction factors (temperature, position) never fall below this share: friction cannot vanish or drive.
SMALLEST_FACTOR = 0.05

#: Newton steps for the position behind an eccentric encoder or the stretch of a joint's spring; 4 reach the last digit.
NEWTON_STEPS = 8


def delayed(s: State, command: float, whole: int, part: float) -> float:
    """Write `command` into the delay line; the one of `whole + part` inner steps ago, fractions blended."""
    length = len(s) - lay.S_LINE
    head = int(s[lay.S_HEAD])
    s[lay.S_LINE + head] = command
    s[lay.S_HEAD] = head + 1.0 if head + 1 < length else 0.0
    new = head - whole
    if new < 0:
        new += length
    if part == 0.0:
        return s[lay.S_LINE + new]
    old = new - 1 if new > 0 else length - 1
    return (1.0 - part) * s[lay.S_LINE + new] + part * s[lay.S_LINE + old]


def delay_steps(delay_s: float, h: float) -> tuple[int, float]:
    """A delay as whole inner steps and the part of one that is left (none when it is next to nothing)."""
    whole = int(delay_s / h + 1e-6)
    part = delay_s / h - whole
    return whole, part if part > 1e-6 else 0.0


def harmonics(p: Params, start: int, rows: int, x: float) -> float:
    """Sum of amplitude*sin(n*x + phase) over the rows of a table."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total += p[i] * math.sin(p[i + 1] * x + p[i + 2])
    return total


def harmonics_slope(p: Params, start: int, rows: int, x: float) -> float:
    """Derivative of `harmonics` by x."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total += p[i] * p[i + 1] * math.cos(p[i + 1] * x + p[i + 2])
    return total


def harmonics_curvature(p: Params, start: int, rows: int, x: float) -> float:
    """Second derivative of `harmonics` by x."""
    total = 0.0
    for row in range(rows):
        i = start + 3 * row
        total -= p[i] * p[i + 1] * p[i + 1] * math.sin(p[i + 1] * x + p[i + 2])
    return total


def encoder_position(p: Params, x: float) -> float:
    """What an ideal-resolution encoder shows at position `x`: eccentricity added."""
    return x + harmonics(p, int(p[lay.P_ECCENTRICITY]), int(p[lay.P_ECCENTRICITY_N]), x)


def behind_encoder(p: Params, shown: float, rate: float, rate_of_rate: float) -> tuple[float, float, float]:
    """True position, velocity, acceleration behind what the encoder shows: `encoder_position` inverted by Newton.

    The model checks that the encoder's slope is positive everywhere, so that there is one answer.
    """
    start, rows = int(p[lay.P_ECCENTRICITY]), int(p[lay.P_ECCENTRICITY_N])
    if rows == 0:
        return shown, rate, rate_of_rate
    x = shown
    for _ in range(NEWTON_STEPS):
        x -= (x + harmonics(p, start, rows, x) - shown) / (1.0 + harmonics_slope(p, start, rows, x))
    slope = 1.0 + harmonics_slope(p, start, rows, x)
    velocity = rate / slope
    return x, velocity, (rate_of_rate - harmonics_curvature(p, start, rows, x) * velocity * velocity) / slope


def actuator(p: Params, torque: float, command: float, h: float) -> float:
    """Torque behind gain, limit, lag and slew rate, one step of `h` s after it was `torque`; the lag is exact."""
    goal = actuator_goal(p, command)
    if p[lay.P_LAG_S] > 0.0:
        goal = torque + (goal - torque) * (1.0 - math.exp(-h / p[lay.P_LAG_S]))
    if p[lay.P_SLEW] > 0.0:
        reach = p[lay.P_SLEW] * h
        goal = min(max(goal, torque - reach), torque + reach)
    return goal


def actuator_goal(p: Params, command: float) -> float:
    """The torque that a command leads to when it is held: gain, then limit."""
    goal = command * (p[lay.P_GAIN_POSITIVE] if command >= 0.0 else p[lay.P_GAIN_NEGATIVE])
    return limited(p, goal) if p[lay.P_LIMIT_POSITIVE] > 0.0 else goal


def limited(p: Params, torque: float) -> float:
    """The torque behind the drive's limit, hard or tanh."""
    limit = p[lay.P_LIMIT_POSITIVE] if torque >= 0.0 else p[lay.P_LIMIT_NEGATIVE]
    if p[lay.P_LIMIT_SOFT] > 0.0:
        return limit * math.tanh(torque / limit)
    return min(max(torque, -limit), limit)


def ripple(p: Params, x: float) -> float:
    """Factor of torque ripple at position `x`."""
    if p[lay.P_RIPPLE_N] == 0.0:
        return 1.0
    return 1.0 + harmonics(p, int(p[lay.P_RIPPLE]), int(p[lay.P_RIPPLE_N]), x)


def offset(p: Params, s: State) -> float:
    """Constant torque beside the command, with what it has drifted since the first step."""
    if p[lay.P_OFFSET_PER_S] == 0.0:
        return p[lay.P_OFFSET]
    return p[lay.P_OFFSET] + p[lay.P_OFFSET_PER_S] * drifted(s, p[lay.P_OFFSET_TIME_S])


def drifted(s: State, limit_s: float) -> float:
    """Time since the first step, s; of a drift that ends (`limit_s` above 0), the time it would take without an end."""
    time_s = s[lay.S_TIME_S] - s[lay.S_FIRST_S]
    return time_s if limit_s == 0.0 else limit_s * (1.0 - math.exp(-time_s / limit_s))


def resisting_torque(p: Params, x: float, velocity: float, time_s: float) -> float:
    """Cogging and the tables of unexplained torque: what resists on the motor side besides friction."""
    torque = 0.0
    if p[lay.P_COGGING_N] > 0.0:
        torque += harmonics(p, int(p[lay.P_COGGING]), int(p[lay.P_COGGING_N]), x)
    if p[lay.P_RESIDUAL_POSITION_N] > 0.0:
        torque += interpolate(p, int(p[lay.P_RESIDUAL_POSITION]), int(p[lay.P_RESIDUAL_POSITION_N]), x, False)
    if p[lay.P_RESIDUAL_VELOCITY_N] > 0.0:
        torque += interpolate(p, int(p[lay.P_RESIDUAL_VELOCITY]), int(p[lay.P_RESIDUAL_VELOCITY_N]), velocity, False)
    if p[lay.P_RESIDUAL_TIME_N] > 0.0:
        torque += interpolate(p, int(p[lay.P_RESIDUAL_TIME]), int(p[lay.P_RESIDUAL_TIME_N]), time_s, False)
    return torque


def load_torque(p: Params, x: float, time_s: float) -> float:
    """Gravity, spring and disturbance: what resists on the load side."""
    torque = p[lay.P_GRAVITY] * math.sin(x + p[lay.P_GRAVITY_PHASE]) if p[lay.P_GRAVITY] != 0.0 else 0.0
    if p[lay.P_SPRING] != 0.0 or p[lay.P_SPRING_CUBIC] != 0.0:
        stretch = x - p[lay.P_SPRING_REST]
        torque += (p[lay.P_SPRING] + p[lay.P_SPRING_CUBIC] * stretch * stretch) * stretch
    for row in range(int(p[lay.P_DISTURBANCE_N])):
        i = int(p[lay.P_DISTURBANCE]) + 5 * row
        if p[i] <= time_s < p[i + 1]:
            torque -= p[i + 2] * math.cos(2.0 * math.pi * p[i + 3] * (time_s - p[i]) + p[i + 4])
    return torque


def dry_factor(p: Params, x: float) -> float:
    """Factor of dry friction over position."""
    factor = 1.0
    if p[lay.P_POSITION_FRICTION_N] > 0.0:
        factor += harmonics(p, int(p[lay.P_POSITION_FRICTION]), int(p[lay.P_POSITION_FRICTION_N]), x)
    for row in range(int(p[lay.P_BUMPS_N])):
        i = int(p[lay.P_BUMPS]) + 3 * row
        away = (x - p[i]) / p[i + 1]
        factor += p[i + 2] * math.exp(-0.5 * away * away)
    return max(factor, SMALLEST_FACTOR)


def nonlinear_viscous(p: Params, velocity: float) -> float:
    """Viscous coefficient to add at this velocity, so that coefficient*v is the group's torque."""
    speed = abs(velocity)
    coefficient = (p[lay.P_QUADRATIC] + p[lay.P_CUBIC] * speed) * speed
    if p[lay.P_POWER] != 0.0 and speed > 1e-9:
        coefficient += p[lay.P_POWER] * speed ** (p[lay.P_POWER_EXPONENT] - 1.0)
    return coefficient


def inertia_at(p: Params, x: float) -> tuple[float, float]:
    """Inertia of the load side (of the whole axis when there is one mass) and its derivative by position."""
    inertia = p[lay.P_LOAD_INERTIA] if p[lay.P_LOAD_INERTIA] > 0.0 else p[lay.P_INERTIA]
    rows = int(p[lay.P_POSITION_INERTIA_N])
    if rows == 0:
        return inertia, 0.0
    start = int(p[lay.P_POSITION_INERTIA])
    return inertia * (1.0 + harmonics(p, start, rows, x)), inertia * harmonics_slope(p, start, rows, x)


def joint_spring(p: Params, stretch: float, ahead: float) -> tuple[float, float, float]:
    """Torque, slope and damping of the joint's spring; `ahead`: stretch expected at mid-step, decides contact."""
    half = 0.5 * p[lay.P_GAP]
    if abs(ahead) < half:
        return 0.0, 0.0, 0.0
    into = stretch - math.copysign(half, ahead)
    bent = p[lay.P_STIFFNESS_CUBIC] * into * into
    return (p[lay.P_STIFFNESS] + bent) * into, p[lay.P_STIFFNESS] + 3.0 * bent, p[lay.P_DAMPING]


def static_stretch(p: Params, torque: float) -> float:
    """Stretch x_motor - x_load under which the joint's spring carries `torque`: the load rests on that side of a gap.

    Newton from the line's answer, which lies beyond the stiffening spring's, so that every step comes closer.
    """
    if torque == 0.0:
        return 0.0
    into = torque / p[lay.P_STIFFNESS]
    for _ in range(NEWTON_STEPS):
        bent = p[lay.P_STIFFNESS_CUBIC] * into * into
        into -= ((p[lay.P_STIFFNESS] + bent) * into - torque) / (p[lay.P_STIFFNESS] + 3.0 * bent)
    return into + math.copysign(0.5 * p[lay.P_GAP], torque)


def spring_step(
    p: Params, s: State, load: float, inertia: float, slope: float, h: float
) -> tuple[float, float, float, float]:
    """Eliminate the load from one step: (torque on the motor, extra viscous of the motor, base, share).

    The joint's spring is taken at mid-step (no numerical damping), its damper and the load's friction implicitly. The
    load's new velocity is base + share*v_motor, so that the motor's friction step stays a scalar equation.
    """
    relative = s[lay.S_VELOCITY] - s[lay.S_LOAD_VELOCITY]
    stretch = s[lay.S_POSITION] - s[lay.S_LOAD_POSITION]
    tau, stiffness, damping = joint_spring(p, stretch, stretch + 0.5 * h * relative)
    tau += 0.25 * h * stiffness * relative
    coupling = 0.25 * h * stiffness + damping
    gain = h / inertia
    speed = s[lay.S_LOAD_VELOCITY]
    whole = 1.0 + gain * (p[lay.P_LOAD_VISCOUS] + coupling)
    base = (speed + gain * (tau - load - 0.5 * slope * speed * speed)) / whole
    share = gain * coupling / whole
    return tau - coupling * base, coupling * (1.0 - share), base, share


def thermal_factors(p: Params, s: State, temperature_c: float) -> tuple[float, float]:
    """Factors of dry and viscous friction at the recorded temperature, or the model's own where that is NaN."""
    if p[lay.P_THERMAL] == 0.0:
        return 1.0, 1.0
    warm = s[lay.S_TEMPERATURE_C] if math.isnan(temperature_c) else temperature_c
    above, drift = warm - p[lay.P_REFERENCE_C], drifted(s, p[lay.P_DRIFT_TIME_S])
    dry, viscous = p[lay.P_DRY_PER_C] * above, p[lay.P_VISCOUS_PER_C] * above
    if p[lay.P_THERMAL_EXPONENTIAL] > 0.0:
        dry, viscous = math.exp(dry) - 1.0, math.exp(viscous) - 1.0
    dry += 1.0 + p[lay.P_DRY_PER_S] * drift
    viscous += 1.0 + p[lay.P_VISCOUS_PER_S] * drift
    return max(dry, SMALLEST_FACTOR), max(viscous, SMALLEST_FACTOR)


def heat(p: Params, s: State, loss_j: float, duration_s: float, temperature_c: float) -> None:
    """Warm the joint by the friction loss of the last steps and let it cool; a recorded temperature wins."""
    if p[lay.P_THERMAL] == 0.0:
        return
    if not math.isnan(temperature_c):
        s[lay.S_TEMPERATURE_C] = temperature_c
        return
    cooled = (s[lay.S_TEMPERATURE_C] - p[lay.P_AMBIENT_C]) * math.exp(-duration_s / p[lay.P_COOLING_S])
    s[lay.S_TEMPERATURE_C] = p[lay.P_AMBIENT_C] + cooled + p[lay.P_HEATING_C_PER_J] * loss_j
