"""Draws what is concealed between command and load: the drive's faults, elasticity, inertia, and torques from outside.

Beside `hidden_friction` and `hidden_place`.
"""

from __future__ import annotations

import math

from servod.qualify.blind import listed
from servod.qualify.blind.concealed import Concealed, Draw


def backlash(draw: Draw) -> Concealed:
    """A gap before a stiff contact; otherwise a contact that stiffens and hardly damps."""
    p = draw.physics
    load = draw.between(0.45, 0.7) * p.inertia
    motor = p.inertia - load
    gap = draw.size(0.003, 0.008) * draw.axis.motions.travel
    stiffness = (2.0 * math.pi * draw.between(60.0, 110.0)) ** 2 * load * motor / p.inertia
    damping = (0.15 if draw.other else 0.5) * 2.0 * math.sqrt(stiffness * load * motor / p.inertia)
    changes = _split(draw, load) | {"joint_gap": gap, "joint_stiffness": stiffness, "joint_damping": damping}
    if draw.other:
        changes["joint_cubic"] = 2.0 * stiffness / gap**2
    group = {"gap": gap, "load_inertia": load, "stiffness": stiffness, "damping": damping}
    told = {"gap": gap, "load_inertia": load}
    believed = {"inertia": p.inertia, "viscous": p.viscous}
    model = None if draw.other else {listed.BACKLASH: group | {"load_viscous": changes["load_viscous"]}}
    return Concealed(changes, told, model, believed)


def joint_elasticity(draw: Draw) -> Concealed:
    """A soft joint; otherwise one that stiffens with its stretch."""
    p = draw.physics
    load = draw.between(0.4, 0.7) * p.inertia
    motor = p.inertia - load
    weak = 2.0 * math.pi * max(14.0 / math.sqrt(draw.strength), 5.0) * draw.between(0.8, 1.5)
    stiffness = weak**2 * load
    damping = draw.between(0.02, 0.06) * 2.0 * math.sqrt(stiffness * load * motor / p.inertia)
    bend = 0.2 * draw.axis.effort / stiffness
    cubic = 0.5 * stiffness / bend**2 if draw.other else 0.0
    changes = _split(draw, load) | {"joint_stiffness": stiffness, "joint_damping": damping, "joint_cubic": cubic}
    group = {"load_inertia": load, "stiffness": stiffness, "damping": damping, "cubic": cubic}
    told = {"load_inertia": load, "stiffness": stiffness}
    believed = {"inertia": p.inertia, "viscous": p.viscous}
    model = {listed.JOINT_ELASTICITY: group | {"load_viscous": changes["load_viscous"]}}
    return Concealed(changes, told, model, believed)


def _split(draw: Draw, load: float) -> dict[str, float]:
    """One mass made two: `load` of the inertia and a tenth to a fifth of the viscous friction behind the joint."""
    p, share = draw.physics, draw.between(0.1, 0.2)
    return {
        "inertia": p.inertia - load,
        "load_inertia": load,
        "viscous": (1.0 - share) * p.viscous,
        "load_viscous": share * p.viscous,
    }


def torque_gain(draw: Draw) -> Concealed:
    """More or less torque than the command says; otherwise by the command's sign."""
    off = 0.12 + min(draw.size(0.03, 0.15), 0.4)
    factor = 1.0 + off if draw.flip() else 1.0 / (1.0 + off)
    back = factor * draw.one_of(0.94, 1.06) if draw.other else factor
    group = {"factor": factor} | ({"negative_factor": back} if draw.other else {})
    return Concealed({"gain_front": factor, "gain_back": back}, group, {listed.TORQUE_GAIN: group})


def torque_saturation(draw: Draw) -> Concealed:
    """A hard limit that the faster motions meet; otherwise iron that saturates."""
    share = max(0.62 / draw.strength**0.5, 0.25) * draw.between(0.85, 1.15)
    limit = share * draw.axis.effort * (1.25 if draw.other else 1.0)
    group = {"limit": limit}
    model = {listed.TORQUE_SATURATION: {"limit": limit, "shape": "tanh" if draw.other else "hard"}}
    return Concealed({"limit": limit, "limit_shape": float(draw.other)}, group, model)


def delay(draw: Draw) -> Concealed:
    """A longer dead time; otherwise with a little lag as well."""
    more = round(1e3 * (0.0025 + min(draw.size(0.001, 0.004), 0.009)), 1) * 1e-3
    lag = 0.1 * more if draw.other else 0.0
    changes = {"delay_s": draw.physics.delay_s + more, "lag_s": lag}
    model = {listed.DELAY: {"additional_s": more}} | (
        {listed.ACTUATOR_LAG: {"time_constant_s": lag}} if draw.other else {}
    )
    return Concealed(changes, {"additional_s": more + lag}, model)


def actuator_lag(draw: Draw) -> Concealed:
    """A lag of first order; otherwise of second order or a limited rate."""
    lag = min(draw.size(0.003, 0.008), 0.02)
    if draw.other and draw.flip():
        slew = draw.axis.effort * 2.0 * math.pi * 2.0 * draw.axis.motions.tempo / max(draw.strength, 1.0)
        return Concealed({"slew": slew}, {"slew_per_s": slew}, {listed.ACTUATOR_LAG: {"slew_per_s": slew}})
    found = {"time_constant_s": lag}
    order = 2.0 if draw.other else 1.0
    return Concealed({"lag_s": lag, "lag_order": order}, found, None if draw.other else {listed.ACTUATOR_LAG: found})


def inertia(draw: Draw) -> Concealed:
    """Another mass than believed, by more than a tenth."""
    off = 0.15 + min(draw.size(0.05, 0.3), 0.8)
    own = draw.physics.inertia
    there = own * (1.0 + off) if draw.flip() else own / (1.0 + off)
    return Concealed({"inertia": there}, {"inertia": there}, {}, {"inertia": own})


def torque_offset(draw: Draw) -> Concealed:
    """A constant torque beside the command."""
    torque = draw.size(0.08, 0.35) * draw.physics.coulomb * draw.sign()
    return Concealed({"offset": torque}, {listed.TORQUE_OFFSET: torque}, {listed.TORQUE_OFFSET: torque})


def disturbance(draw: Draw) -> Concealed:
    """A push for a second or two in one recording; otherwise one that swells."""
    torque, start = draw.size(0.3, 1.0) * draw.physics.coulomb * draw.sign(), draw.between(2.0, 9.0)
    lasts, shape = draw.between(0.8, 3.0), draw.one_of(1.0, 2.0) if draw.other else 0.0
    changes = {"push": torque, "push_start_s": start, "push_end_s": start + lasts, "push_shape": shape}
    told = {} if draw.other else {"start_s": start, "end_s": start + lasts, "torque": torque}
    return Concealed(changes, told, None if draw.other else {}, only=int(draw.one_of(0.0, 1.0, 2.0)))
