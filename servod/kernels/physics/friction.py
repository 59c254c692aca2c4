"""Friction kernels: the Stribeck curve, the LuGre bristle and set-valued Coulomb friction, each one implicit step.

Called by `servod.kernels.physics.dynamics` once per inner step. Plain functions on floats; the same source is compiled.
"""

from __future__ import annotations

import math

from servod.kernels.physics.layout import PlantParameters, Tables

#: exp(-x) is under the last digit of a sum with 1 beyond this x.
EXP_IS_NOTHING = 40.0


def interpolate(tables: Tables, start: int, rows: int, x: float, hold: bool) -> float:
    """Piecewise linear table of (x, y) rows at `tables[start]`; outside it, the end values when `hold`, else 0."""
    last = start + 2 * (rows - 1)
    if x <= tables[start]:
        return tables[start + 1] if hold or x == tables[start] else 0.0
    if x >= tables[last]:
        return tables[last + 1] if hold or x == tables[last] else 0.0
    low, high = 0, rows - 1
    while high - low > 1:
        middle = (low + high) // 2
        if tables[start + 2 * middle] <= x:
            low = middle
        else:
            high = middle
    x0, y0 = tables[start + 2 * low], tables[start + 2 * low + 1]
    x1, y1 = tables[start + 2 * high], tables[start + 2 * high + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


def stribeck_curve(p: PlantParameters, tables: Tables, velocity: float) -> float:
    """Dry friction torque g(v) > 0 at steady sliding, without asymmetry: the paper's (18), exponent's sign mended."""
    speed = abs(velocity)
    if p.local_positive_n > 0:
        return _local_curve(p, tables, velocity, speed)
    extra = p.static - p.coulomb
    if extra == 0.0:
        return p.coulomb
    ratio = speed / p.stribeck_velocity
    power = ratio * ratio if p.stribeck_exponent == 2.0 else ratio**p.stribeck_exponent
    if power > EXP_IS_NOTHING:
        return p.coulomb
    return p.coulomb + extra * math.exp(-power)


def _local_curve(p: PlantParameters, tables: Tables, velocity: float, speed: float) -> float:
    """Local sets: the map (7) less its viscous part on both sides of the joint, never below a hundredth of the map."""
    if velocity >= 0.0:
        steady = interpolate(tables, p.local_positive, p.local_positive_n, speed, True)
    else:
        steady = interpolate(tables, p.local_negative, p.local_negative_n, speed, True)
    return max(steady - (p.viscous + p.load_viscous) * speed, 0.01 * steady)


def directed_curve(p: PlantParameters, tables: Tables, velocity: float) -> float:
    """g(v) with asymmetry: what the bristle settles to at steady velocity, sigma0*|z| = g(v)."""
    return stribeck_curve(p, tables, velocity) * (p.positive_dry if velocity >= 0.0 else p.negative_dry)


def bristle_step(
    velocity: float,
    bristle: float,
    torque: float,
    inertia: float,
    h: float,
    dry: float,
    sigma0: float,
    sigma1: float,
    viscous: float,
) -> tuple[float, float, float]:
    """One implicit step of m*dv/dt = torque - F with the LuGre bristle; returns (v, z, F) after `h` seconds.

    z and v are solved together (backward Euler, the bristle's rate sigma0*|v|/g frozen at the step's start), so it is
    stable at any step. sigma1 acts at every speed, as the law has it: where g changes along the way or with the load,
    the bristle follows and its damping shows. Passive up to sigma1*|v| = 4*g (Barabanov, Ortega, IEEE TAC 45, 2000).
    """
    speed = abs(velocity)
    # everything is multiplied by g(v)*(1 + rate*h) = dry + sigma0*|v|*h: one division less in the chain that waits
    whole = dry + sigma0 * speed * h
    memory = (dry - sigma1 * speed) * sigma0 * bristle
    slope = (sigma0 * h + sigma1) * dry
    gain = h / inertia
    new_velocity = (velocity * whole + gain * (torque * whole - memory)) / (whole + gain * (slope + viscous * whole))
    shrink = 1.0 / whole
    friction = (memory + slope * new_velocity) * shrink + viscous * new_velocity
    return new_velocity, (bristle + h * new_velocity) * dry * shrink, friction


def coulomb_step(
    velocity: float, torque: float, inertia: float, h: float, dry: float, viscous: float
) -> tuple[float, float]:
    """One step of m*dv/dt = torque - dry*Sign(v) - viscous*v with Sign(0) = [-1, 1]; returns (v, F) after `h` seconds.

    Moreau's time stepping: the joint sticks exactly when `dry` can hold it; no regularisation, passive at any step.
    """
    gain = h / inertia
    free = velocity + gain * torque
    grip = gain * dry
    if abs(free) <= grip:
        return 0.0, torque + velocity / gain
    new_velocity = (free - grip if free > 0.0 else free + grip) / (1.0 + gain * viscous)
    return new_velocity, torque - (new_velocity - velocity) / gain
