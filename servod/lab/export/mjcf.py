"""An axis as MJCF, the language of MuJoCo 4: what it says of a model, and the file.

Bristles, the Stribeck curve and cogging are passive motors (`dcmotor` with input "none"), delay and lag stand in the
actuator, motor and load are two joints with a tendon between them. Source: MuJoCo's XML reference, version 4.
"""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.axis_model import AxisKind, AxisModel, LugreFriction
from servod.lab.export import reduce as r

#: Standard gravity [m/s^2]; the weight of the exported body is chosen to it.
GRAVITY_M_S2 = 9.80665
#: Step of the exported model [s]: bristles and springs of real joints need it.
STEP_S = 1e-4
#: How stiff the engine's own dry friction is, where no bristle stands: its time constant [s] and impedance.
SOLREF, SOLIMP = (0.001, 1.0), (0.99, 0.999, 0.001)

#: What MJCF has no words for, in the order in which it is taken away.
LOSSES: tuple[r.LostEffect, ...] = (
    r.part("stribeck.exponent", exponent=2.0),
    r.part("presliding.damping_velocity", damping_velocity=None),
    r.LostEffect("friction.local", r.map_lost),
    r.LostEffect("friction.stribeck", r.curve_lost),
    r.part("viscous_nonlinear.power", power=0.0),
    r.LostEffect("cogging.harmonics", r.broken_waves_lost),
    r.LostEffect("gravity.amplitude", r.gravity_of_a_slide_lost),
    r.part("torque_gain.negative_factor", negative_factor=None),
    r.LostEffect("torque_saturation.shape", r.soft_limit_lost),
    r.part("actuator_lag.slew_per_s", slew_per_s=None),
    *r.groups_but(
        *(fr.Stribeck, fr.Presliding, fr.ViscousNonlinear, fx.Gravity, fx.Spring, fx.Cogging, fx.JointElasticity),
        *(fx.Backlash, fx.TorqueGain, fx.TorqueSaturation, fx.Delay, fx.ActuatorLag),
    ),
)


def says(model: AxisModel) -> AxisModel:
    """The model as MJCF says it, in the plainest keys."""
    return r.folded(r.reduced(model, LOSSES))


def write(model: AxisModel, name: str) -> str:
    """A model that `says` gave, as the text of an MJCF file; `name` is that of the joint.

    The command is the control of the actuator `command`, in N*m (N); the joint's position is that of the model.
    """
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    ET.SubElement(
        root, "option", timestep=numbers(STEP_S), integrator="implicitfast", gravity=f"0 0 {numbers(-GRAVITY_M_S2)}"
    )
    world, actuators = ET.SubElement(root, "worldbody"), ET.Element("actuator")
    behind = model.two_mass
    load_inertia = behind.load_inertia if behind else 0.0
    _body(world, model, name, model.inertia - load_inertia, motor=True, load=behind is None)
    if behind:
        _body(world, model, f"{name}_load", load_inertia, motor=False, load=True)
        tendon = ET.SubElement(ET.SubElement(root, "tendon"), "fixed", name=f"{name}_spring")
        cubic = model.joint_elasticity.cubic if model.joint_elasticity else 0.0
        tendon.set("stiffness", numbers(behind.stiffness, 0.0, cubic))
        tendon.set("damping", numbers(behind.damping))
        half = 0.5 * model.backlash.gap if model.backlash else 0.0
        tendon.set("springlength", numbers(-half, half))
        ET.SubElement(tendon, "joint", joint=name, coef="1")
        ET.SubElement(tendon, "joint", joint=f"{name}_load", coef="-1")
    _command(actuators, model, name)
    _passive(actuators, model, name)
    root.append(actuators)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _body(world: ET.Element, model: AxisModel, name: str, inertia: float, *, motor: bool, load: bool) -> None:
    """One moving mass with its joint: the motor's side with friction, the load's with weight and spring."""
    law, linear, behind = model.friction, model.axis is AxisKind.LINEAR, model.two_mass
    body = ET.SubElement(world, "body", name=name)
    joint = ET.SubElement(body, "joint", name=name)
    joint.set("type", "slide" if linear else "hinge")
    joint.set("axis", "1 0 0" if linear else "0 1 0")
    viscous = behind.load_viscous if behind and not motor else law.viscous - (behind.load_viscous if behind else 0.0)
    more = model.viscous_nonlinear if motor else None
    joint.set("damping", numbers(viscous, more.quadratic if more else 0.0, more.cubic if more else 0.0))
    if motor and not isinstance(law, LugreFriction) and law.kind != "local" and law.coulomb > 0.0:
        joint.set("frictionloss", numbers(law.coulomb))
        joint.set("solreffriction", numbers(*SOLREF))
        joint.set("solimpfriction", numbers(*SOLIMP))
    if load and model.spring:
        joint.set("stiffness", numbers(model.spring.stiffness, 0.0, model.spring.cubic))
        joint.set("springref", numbers(model.spring.rest))
    mass, centre, moment = weight(model, inertia, weighs=load)
    ET.SubElement(
        body, "inertial", pos=numbers(*centre), mass=numbers(mass), diaginertia=numbers(moment, moment, moment)
    )


def weight(model: AxisModel, inertia: float, *, weighs: bool) -> tuple[float, tuple[float, float, float], float]:
    """(mass kg, place of its centre m, moment about the centre kg*m^2) of a body with `inertia` about its joint.

    A pendulum's weight hangs so that half of the inertia is its own; on a slide the inertia is the mass.
    """
    if model.axis is AxisKind.LINEAR:
        return inertia, (0.0, 0.0, 0.0), 1.0
    pull = model.gravity.amplitude if model.gravity and weighs else 0.0
    if pull == 0.0:
        return 1.0, (0.0, 0.0, 0.0), inertia
    phase = (model.gravity.phase if model.gravity else 0.0) + (math.pi if pull < 0.0 else 0.0)
    mass = 2.0 * pull**2 / (GRAVITY_M_S2**2 * inertia)
    length = abs(pull) / (mass * GRAVITY_M_S2)
    return mass, (-length * math.sin(phase), 0.0, -length * math.cos(phase)), 0.5 * inertia


def _command(actuators: ET.Element, model: AxisModel, name: str) -> None:
    """The command's way: delay, gain, limit, lag; and the constant torque beside it."""
    gain = model.torque_gain.factor if model.torque_gain else 1.0
    command = ET.SubElement(actuators, "general", name="command", joint=name, gainprm=numbers(gain))
    limit = model.torque_saturation
    if limit:
        low = -(limit.negative_limit or limit.limit)
        command.set("ctrlrange", numbers(low / gain, limit.limit / gain))
    if model.actuator_lag and model.actuator_lag.time_constant_s > 0.0:
        command.set("dyntype", "filterexact")
        command.set("dynprm", numbers(model.actuator_lag.time_constant_s))
    if model.total_delay_s > 0.0:
        command.set("delay", numbers(model.total_delay_s))
        command.set("nsample", str(math.ceil(model.total_delay_s / STEP_S) + 2))
    if model.torque_offset:
        still = {"gainprm": "0", "biastype": "affine", "biasprm": numbers(model.torque_offset, 0.0, 0.0)}
        ET.SubElement(actuators, "general", {"name": "offset", "joint": name} | still)


def _passive(actuators: ET.Element, model: AxisModel, name: str) -> None:
    """Bristles and cogging: motors without a command whose electric branch is dead."""
    dead = {"joint": name, "input": "none", "motorconst": "0 0", "resistance": "1"}
    law = model.friction
    if isinstance(law, LugreFriction):
        static = law.coulomb if law.static is None else law.static
        lugre = numbers(law.sigma0, law.sigma1, law.coulomb, static, law.stribeck_velocity)
        ET.SubElement(actuators, "dcmotor", dead, name="friction", lugre=lugre)
    for number, wave in enumerate(model.cogging.harmonics if model.cogging else ()):
        assert wave.periods_per_turn is not None
        cogging = f"{numbers(-wave.amplitude)} {round(wave.periods_per_turn)} {numbers(wave.phase)}"
        ET.SubElement(actuators, "dcmotor", dead, name=f"cogging_{number}", cogging=cogging)


def numbers(*values: float) -> str:
    """Numbers as both languages write them."""
    return " ".join(f"{value:.12g}" for value in values)
