"""The trial's axis in another physics engine: MuJoCo's bodies, tendon, limits, motors and integrator.

Beside `plant`, whose loop it closes in the same way; nothing of the engine is tuned to the diagnosis. It knows no other
forms of an effect than its own: bristles and cogging are its `dcmotor`, a soft joint is a spring tendon between two
bodies, backlash is a second body between limits, weight is a mass that hangs. Needs the wheel `mujoco` (extra `sim`).
"""

from __future__ import annotations

import math
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from servod.qualify.blind import listed
from servod.qualify.blind.physics import Physics
from servod.qualify.blind.plant import FILTER_S, PERIOD_S, STEP_S, STEPS, Loop, shown

Array = NDArray[np.float64]

#: What the engine has means of its own for.
CONCEALS = (
    *(listed.STRIBECK, listed.PRESLIDING, listed.VISCOUS_NONLINEAR, listed.COGGING, listed.GRAVITY, listed.SPRING),
    *(listed.BACKLASH, listed.JOINT_ELASTICITY, listed.TORQUE_GAIN, listed.TORQUE_SATURATION, listed.DELAY),
    *(listed.ACTUATOR_LAG, listed.INERTIA, listed.ENCODER_ECCENTRICITY, listed.TORQUE_OFFSET, listed.DISTURBANCE),
)
_GRAVITY_M_S2 = 9.81
#: Share of a body's inertia that turns with the rotor (armature), and of the rest that its hanging mass has.
_ROTOR, _HANGS = 0.3, 0.6


def description(p: Physics) -> str:
    """The axis as the engine's own model; joint `motor`, its actuator `command`, and `load` where there are two masses.

    Quantities of Physics that the engine has no means for are left out.
    """
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", timestep=_n(STEP_S), integrator="implicitfast", gravity=f"0 0 {-_GRAVITY_M_S2}")
    world = ET.SubElement(root, "worldbody")
    motor = _body(world, "motor", p.inertia, None if p.load_inertia else p)
    drag = p.drag_torque / p.drag_speed**p.drag_exponent
    poly = (drag if p.drag_exponent == 2.0 else 0.0, drag if p.drag_exponent == 3.0 else 0.0)
    slack = p.joint_gap > 0.0
    motor[0].set("damping", _n(p.viscous + (p.load_viscous if slack else 0.0), *poly))
    if p.load_inertia > 0.0:
        load = _body(motor if slack else world, "load", p.load_inertia, p)
        if slack:
            _between_limits(load[0], p)
        else:
            load[0].set("damping", _n(p.load_viscous))
            spring = ET.SubElement(ET.SubElement(root, "tendon"), "fixed", stiffness=_n(p.joint_stiffness))
            spring.set("damping", _n(p.joint_damping))
            ET.SubElement(spring, "joint", joint="motor", coef="1")
            ET.SubElement(spring, "joint", joint="load", coef="-1")
    _actuators(ET.SubElement(root, "actuator"), p)
    return ET.tostring(root, encoding="unicode")


def _body(parent: ET.Element, name: str, inertia: float, load: Physics | None) -> ET.Element:
    """A body on a hinge of its own; `load`: what pulls at it."""
    body = ET.SubElement(parent, "body", name=name)
    joint = ET.SubElement(body, "joint", name=name, axis="0 1 0", armature=_n(_ROTOR * inertia))
    rest = (1.0 - _ROTOR) * inertia
    mass, centre, own = 1.0, (0.0, 0.0, 0.0), rest
    if load is not None and load.gravity != 0.0:
        own = (1.0 - _HANGS) * rest
        mass = load.gravity**2 / (_GRAVITY_M_S2**2 * _HANGS * rest)
        length = load.gravity / (mass * _GRAVITY_M_S2)
        centre = (-length * math.sin(load.gravity_phase), 0.0, -length * math.cos(load.gravity_phase))
    if load is not None and load.spring > 0.0:
        joint.set("stiffness", _n(load.spring))
        joint.set("springref", _n(load.spring_rest))
    ET.SubElement(body, "inertial", pos=_n(*centre), mass=_n(mass), diaginertia=_n(own, own, own))
    return body


def _between_limits(joint: ET.Element, p: Physics) -> None:
    """The load's joint stands on the motor's body and moves freely between two limits, which give a little."""
    total = p.inertia + p.load_inertia
    square = p.joint_stiffness * total / (p.inertia * p.load_inertia)
    damping = p.joint_damping * total / (p.inertia * p.load_inertia)
    joint.set("limited", "true")
    joint.set("range", _n(-0.5 * p.joint_gap, 0.5 * p.joint_gap))
    joint.set("solreflimit", _n(-square, -damping))
    joint.set("solimplimit", "0.99 0.999 0.0001")


def _actuators(found: ET.Element, p: Physics) -> None:
    command = ET.SubElement(found, "general", name="command", joint="motor", gainprm=_n(p.gain_front))
    if p.limit > 0.0:
        command.set("ctrllimited", "true")
        command.set("ctrlrange", _n(-p.limit / p.gain_front, p.limit / p.gain_front))
    if p.lag_s > 0.0:
        command.set("dyntype", "filterexact")
        command.set("dynprm", _n(p.lag_s))
    command.set("delay", _n(p.delay_s))
    command.set("nsample", str(math.ceil(p.delay_s / STEP_S) + 2))
    if p.offset:
        still = {"gainprm": "0", "biastype": "affine", "biasprm": _n(p.offset, 0.0, 0.0)}
        ET.SubElement(found, "general", still, joint="motor")
    passive = {"joint": "motor", "input": "none", "motorconst": "0 0", "resistance": "1"}
    bristles = _n(p.sigma0, p.sigma1, p.coulomb, p.static, p.stribeck_velocity)
    ET.SubElement(found, "dcmotor", passive, lugre=bristles)
    for harmonic, torque in ((1.0, p.cogging), (2.0, p.cogging_second)):
        if torque:
            wave = f"{_n(-torque)} {round(harmonic * p.cogging_order)} {_n(harmonic * p.cogging_phase)}"
            ET.SubElement(found, "dcmotor", passive, cogging=wave)


def run(p: Physics, loop: Loop, _start: Array, reference: Array, noise: Array, jitter: Array, out: Array) -> None:
    """Follow `reference` from rest, as `plant.run` does; rows of `out`: command, reading, temperature (25 degC).

    Raises ImportError without the wheel.
    """
    import mujoco

    model: Any = mujoco.MjModel.from_xml_string(description(p))
    data = mujoco.MjData(model)
    x, pushed = model.joint("motor").qposadr[0], model.nv - 1
    slope, integral, last = 0.0, 0.0, reference[0] - shown(p, 0.0, jitter[0], loop.counts)
    for row in range(len(reference)):
        out[row, 1], out[row, 2] = shown(p, float(data.qpos[x]), jitter[row], loop.counts), 25.0
        error = reference[row] - out[row, 1]
        slope += ((error - last) / PERIOD_S - slope) * (1.0 - math.exp(-PERIOD_S / FILTER_S))
        wanted = loop.kp * error + loop.kd * slope + loop.ki * integral
        out[row, 0] = min(max(wanted, -loop.limit), loop.limit)
        if out[row, 0] == wanted:
            integral += PERIOD_S * error
        last = error
        data.ctrl[0] = out[row, 0]
        data.qfrc_applied[:] = 0.0
        data.qfrc_applied[0] = noise[row]
        data.qfrc_applied[pushed] += p.push if p.push_start_s <= row * PERIOD_S < p.push_end_s else 0.0
        mujoco.mj_step(model, data, nstep=STEPS)


def _n(*values: float) -> str:
    return " ".join(f"{value:.12g}" for value in values)
