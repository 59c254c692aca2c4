"""The trial's plant in its closed loop, compiled: reference and noise in, command and encoder reading out.

Stands on `physics` alone. Its integrator is not the simulator's: the velocity at mid-step is extrapolated from the last
acceleration, the bristle is solved exactly for that velocity, and both masses then take one explicit step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from servod.qualify.blind.physics import Physics

Array = NDArray[np.float64]
F = TypeVar("F", bound=Callable[..., Any])

#: Inner steps in a period of the loop, and their length in s.
STEPS, PERIOD_S = 20, 1e-3
STEP_S = PERIOD_S / STEPS

#: Friction factors never fall below this share.
LEAST_FACTOR = 0.05

#: Time constant of the filter behind the difference quotient of the loop's error, s.
FILTER_S = 0.002

# places in the state
X, V, Z, LOAD_X, LOAD_V, TORQUE, TORQUE_RATE, WARMTH, FOLLOWER, CHAOS, WAY, REST_S, LAST_A, LAST_LOAD_A, DRAW = (
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 13, 14, 15, 16,
)  # fmt: skip
STATES = 17


class Loop(NamedTuple):
    """The controller: gains in N*m/rad, N*m*s/rad and N*m/(rad*s), its limit in N*m, counts of the encoder per turn."""

    kp: float
    kd: float
    ki: float
    limit: float
    counts: float


def kernel(function: F) -> F:
    """`function` as machine code."""
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))


def rest(temperature_c: float = 25.0, seed: float = 0.0) -> Array:
    """An axis at rest at 0; `seed` sets what chance there is in unknown loads."""
    state = np.zeros(STATES)
    state[WARMTH], state[DRAW] = temperature_c, seed
    state[CHAOS : CHAOS + 3] = 1.0 + 0.1 * seed, 1.0, 20.0
    return state


@kernel
def wave(shape: float, angle: float) -> float:
    """A wave of amplitude 1: sine (0), triangle (1), or a sine leaning forward (2)."""
    if shape == 1.0:
        return 2.0 / math.pi * math.asin(math.sin(angle))
    if shape == 2.0:
        return math.sin(angle + 0.35 * math.sin(angle))
    return math.sin(angle)


@kernel
def dry_friction(p: Physics, s: Array, speed: float, forward: bool, torque: float, load: float) -> float:
    """Dry friction at steady sliding, N*m."""
    fade = math.exp(-((speed / p.stribeck_velocity) ** p.stribeck_exponent))
    dry = (p.coulomb + (p.static - p.coulomb) * fade) * (p.front_dry if forward else p.back_dry)
    factor = 1.0 + p.grip_share * wave(p.grip_shape, p.grip_order * s[X] + p.grip_phase)
    if p.spot_share != 0.0:
        factor += p.spot_share * math.exp(-0.5 * ((s[X] - p.spot_place) / p.spot_width) ** 2)
    if p.way_share != 0.0:
        factor += p.way_share * math.sin(2.0 * math.pi * s[WAY] / p.way_length)
    if p.patchy_share != 0.0:
        factor += p.patchy_share * (1.0 if math.sin(91.7 * math.floor(s[DRAW])) > 0.1 else 0.0)
    if p.ageing != 0.0:
        factor += p.ageing * (1.0 - math.exp(-s[REST_S] / p.ageing_s))
    dry *= max(factor, LEAST_FACTOR)
    dry = dry * warmth(p, p.warm_dry, s[WARMTH]) + p.dry_per_torque * abs(torque) + p.dry_per_load * abs(load)
    return float(dry)


@kernel
def warmth(p: Physics, rate: float, temperature_c: float) -> float:
    """Factor of friction at a temperature."""
    if rate == 0.0:
        return 1.0
    away = temperature_c - 25.0
    return max(math.exp(-rate * away) if p.warm_shape == 1.0 else 1.0 - rate * away, LEAST_FACTOR)


@kernel
def wet_friction(p: Physics, velocity: float, temperature_c: float) -> float:
    """What of friction grows with speed, and the cage's resonance, N*m."""
    speed = abs(velocity)
    wet = p.viscous * (p.front_viscous if velocity >= 0.0 else p.back_viscous) * speed
    if p.drag_torque != 0.0:
        wet += p.drag_torque * (speed / p.drag_speed) ** p.drag_exponent
    wet *= warmth(p, p.warm_viscous, temperature_c)
    if p.peak_torque != 0.0:
        wet += p.peak_torque * math.exp(-(((speed - p.peak_speed) / p.peak_width) ** 2))
    return float(math.copysign(wet, velocity))


@kernel
def bristle(p: Physics, z: float, velocity: float, dry: float) -> float:
    """The bristle's stretch after one step at constant velocity; exact for LuGre's law."""
    way = abs(velocity) * STEP_S
    if way == 0.0:
        return z
    most = dry / p.sigma0
    goal = math.copysign(most, velocity)
    share = 1.0
    if p.elastic_share > 0.0 and z * velocity > 0.0:
        plastic = (abs(z) / most - p.elastic_share) / (1.0 - p.elastic_share)
        share = 0.0 if plastic <= 0.0 else min(0.5 - 0.5 * math.cos(math.pi * plastic), 1.0) if plastic < 1.0 else 1.0
    elif p.elastic_share > 0.0:
        share = 0.0
    if share < 1e-9:
        return z + velocity * STEP_S
    decay = math.exp(-share * way / most)
    return goal / share + (z - goal / share) * decay


@kernel
def load_torque(p: Physics, s: Array, x: float, time_s: float) -> float:
    """What resists on the load side, N*m."""
    torque = p.gravity * math.sin(x + p.gravity_phase) + p.gravity_second * math.sin(2.0 * x)
    stretch = x - p.spring_rest
    if p.spring_slack > 0.0:
        stretch = math.copysign(max(abs(stretch) - p.spring_slack, 0.0), stretch)
    torque += (p.spring + p.spring_cubic * stretch * stretch) * stretch
    if p.push != 0.0 and p.push_start_s <= time_s < p.push_end_s:
        done = (time_s - p.push_start_s) / (p.push_end_s - p.push_start_s)
        form = math.sin(math.pi * done) if p.push_shape == 1.0 else done if p.push_shape == 2.0 else 1.0
        torque -= p.push * form
    torque += p.relaxing * (x - s[FOLLOWER]) + p.chaos * s[CHAOS] / 8.0
    return float(torque)


@kernel
def drive(p: Physics, s: Array, command: float) -> float:
    """The torque that the drive makes, N*m; advances its lag by one step."""
    goal = command * (p.gain_front if command >= 0.0 else p.gain_back)
    if p.limit > 0.0:
        goal = p.limit * math.tanh(goal / p.limit) if p.limit_shape == 1.0 else min(max(goal, -p.limit), p.limit)
    if p.lag_s == 0.0 and p.slew == 0.0:
        s[TORQUE] = goal
    elif p.lag_order == 2.0:
        fast = 2.0 / p.lag_s
        s[TORQUE_RATE] += STEP_S * fast * (fast * (goal - s[TORQUE]) - 1.7 * s[TORQUE_RATE])
        s[TORQUE] += STEP_S * s[TORQUE_RATE]
    else:
        change = (goal - s[TORQUE]) * (1.0 - math.exp(-STEP_S / p.lag_s) if p.lag_s > 0.0 else 1.0)
        reach = p.slew * STEP_S if p.slew > 0.0 else abs(change)
        s[TORQUE] += min(max(change, -reach), reach)
    ripple = p.ripple_share * wave(p.ripple_shape, p.ripple_order * s[X] + p.ripple_phase)
    return float(s[TORQUE] * (1.0 + ripple))


@kernel
def joint_torque(p: Physics, stretch: float, rate: float) -> float:
    """What the joint's spring carries, N*m."""
    half = 0.5 * p.joint_gap
    if abs(stretch) < half:
        return 0.0
    into = stretch - math.copysign(half, stretch)
    return (p.joint_stiffness + p.joint_cubic * into * into) * into + p.joint_damping * rate


@kernel
def swing(p: Physics, x: float) -> tuple[float, float]:
    """Factor of inertia over position and its slope."""
    angle = p.swing_order * x + p.swing_phase
    factor = 1.0 + p.swing_share * math.sin(angle) + p.swing_second * math.sin(2.0 * angle)
    return factor, p.swing_order * (p.swing_share * math.cos(angle) + 2.0 * p.swing_second * math.cos(2.0 * angle))


@kernel
def step(p: Physics, s: Array, command: float, noise: float, time_s: float) -> None:
    """Advance everything by one inner step."""
    mid = s[V] + 0.5 * STEP_S * s[LAST_A]
    made = drive(p, s, command)
    load = load_torque(p, s, s[LOAD_X], time_s)
    cogging = p.cogging * wave(p.cogging_shape, p.cogging_order * s[X] + p.cogging_phase)
    cogging += p.cogging_second * math.sin(2.0 * (p.cogging_order * s[X] + p.cogging_phase))
    dry = dry_friction(p, s, abs(mid), mid >= 0.0, made, load)
    z = bristle(p, s[Z], mid, dry)
    friction = 0.5 * p.sigma0 * (s[Z] + z) + p.sigma1 * (z - s[Z]) / STEP_S + wet_friction(p, mid, s[WARMTH])
    torque = made + p.offset + noise - friction - cogging
    s[Z] = z
    if p.load_inertia > 0.0:
        load_mid = s[LOAD_V] + 0.5 * STEP_S * s[LAST_LOAD_A]
        carried = joint_torque(p, s[X] - s[LOAD_X] + 0.5 * STEP_S * (s[V] - s[LOAD_V]), mid - load_mid)
        torque -= carried
        s[LAST_LOAD_A] = (carried - load - p.load_viscous * load_mid) / p.load_inertia
        s[LOAD_X] += STEP_S * (s[LOAD_V] + 0.5 * STEP_S * s[LAST_LOAD_A])
        s[LOAD_V] += STEP_S * s[LAST_LOAD_A]
        s[LAST_A] = torque / p.inertia
    else:
        factor, slope = swing(p, s[X])
        s[LAST_A] = ((torque - load) / p.inertia - 0.5 * slope * mid * mid) / factor
    s[X] += STEP_S * (s[V] + 0.5 * STEP_S * s[LAST_A])
    s[V] += STEP_S * s[LAST_A]
    if p.load_inertia == 0.0:
        s[LOAD_X], s[LOAD_V] = s[X], s[V]
    remember(p, s, friction * mid)


@kernel
def remember(p: Physics, s: Array, loss_w: float) -> None:
    """Advance what is slow: warmth, way, time at rest, loads with a life of their own."""
    s[WARMTH] += STEP_S * (p.heating * abs(loss_w) - (s[WARMTH] - 25.0) / p.cooling_s)
    s[WAY] += STEP_S * abs(s[V])
    if p.relaxing != 0.0:
        s[FOLLOWER] += STEP_S * (s[LOAD_X] - s[FOLLOWER]) / p.relaxing_s
    if p.patchy_share != 0.0:
        s[DRAW] += STEP_S / p.patchy_s
    if p.ageing != 0.0:
        s[REST_S] = s[REST_S] + STEP_S if abs(s[V]) < 0.3 * p.stribeck_velocity else max(s[REST_S] - 40.0 * STEP_S, 0.0)
    if p.chaos != 0.0:  # Lorenz, J. Atmos. Sci. 20, 1963
        a, b, c = s[CHAOS], s[CHAOS + 1], s[CHAOS + 2]
        h = STEP_S * p.chaos_rate
        s[CHAOS] = a + h * 10.0 * (b - a)
        s[CHAOS + 1] = b + h * (a * (28.0 - c) - b)
        s[CHAOS + 2] = c + h * (a * b - 8.0 / 3.0 * c)


@kernel
def shown(p: Physics, x: float, jitter: float, counts: float) -> float:
    """The encoder's reading at position `x`, rad."""
    angle = p.eccentricity_order * x + p.eccentricity_phase
    x += p.eccentricity * math.sin(angle) + p.eccentricity_second * math.sin(2.0 * angle)
    count = 2.0 * math.pi / counts
    return count * math.floor(x / count + jitter + 0.5)


@kernel
def run(p: Physics, loop: Loop, s: Array, reference: Array, noise: Array, jitter: Array, out: Array) -> None:
    """Follow `reference` (rad, one row a millisecond) from state `s`; rows of `out`: command, reading, temperature.

    `noise` is a torque (N*m) held over each period, `jitter` the encoder's noise in counts.
    """
    late = round(p.delay_s / STEP_S)
    slope, integral, last = 0.0, 0.0, reference[0] - shown(p, s[X], jitter[0], loop.counts)
    for row in range(len(reference)):
        out[row, 1] = shown(p, s[X], jitter[row], loop.counts)
        out[row, 2] = s[WARMTH]
        error = reference[row] - out[row, 1]
        slope += ((error - last) / PERIOD_S - slope) * (1.0 - math.exp(-PERIOD_S / FILTER_S))
        wanted = loop.kp * error + loop.kd * slope + loop.ki * integral
        out[row, 0] = min(max(wanted, -loop.limit), loop.limit)
        if out[row, 0] == wanted:
            integral += PERIOD_S * error
        last = error
        for inner in range(STEPS):
            acts = (row * STEPS + inner - late) // STEPS
            step(p, s, out[acts, 0] if acts >= 0 else 0.0, noise[row], row * PERIOD_S + inner * STEP_S)
