"""An axis as URDF: inertia, weight, dry and viscous friction, largest torque; nothing else has words there.

Source: the URDF specification of ROS (joint: dynamics, limit; link: inertial). How an engine holds a joint under dry
friction, and whether it obeys the largest torque, is the engine's.
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

from servod.formats.model import effects as fx
from servod.formats.model import friction as fr
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.lab.export import mjcf
from servod.lab.export import reduce as r

#: A slide without a stated way goes this far [m]; the format wants limits there.
_FAR_M = 1e3
_NO_LIMIT = 1e9


def _alike(model: AxisModel) -> AxisModel:
    limit = model.torque_saturation
    if limit is None or limit.negative_limit is None:
        return model
    return model.model_copy(update={"torque_saturation": limit.model_copy(update={"negative_limit": None})})


#: What URDF has no words for. The curves of friction are lost one by one, so that each has its own cost.
LOSSES: tuple[r.LostEffect, ...] = (
    r.LostEffect("friction.local", r.map_lost),
    r.LostEffect("friction.stribeck", r.static_lost),
    r.LostEffect("friction.bristle", r.bristle_lost),
    r.LostEffect("gravity.amplitude", r.gravity_of_a_slide_lost),
    r.LostEffect("torque_saturation.negative_limit", _alike),
    r.LostEffect("torque_saturation.shape", r.soft_limit_lost),
    r.LostEffect("torque_offset", r.offset_lost),
    r.LostEffect("delay_s", r.delay_lost),
    *r.groups_but(fr.Stribeck, fr.Presliding, fx.Gravity, fx.TorqueSaturation, fx.Delay),
)


def says(model: AxisModel) -> AxisModel:
    """The model as URDF says it."""
    return r.folded(r.reduced(model, LOSSES))


def write(model: AxisModel, name: str) -> str:
    """A model that `says` gave, as the text of a URDF file; `name` is that of the joint."""
    root = ET.Element("robot", name=name)
    # MuJoCo's own element, which other readers pass over: a link on the world stays a body of its own.
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", fusestatic="false", discardvisual="true")
    ET.SubElement(root, "link", name="base")
    link = ET.SubElement(root, "link", name=f"{name}_link")
    linear = model.axis is AxisKind.LINEAR
    inertial = ET.SubElement(link, "inertial")
    mass, centre, moment = mjcf.weight(model, model.inertia, weighs=not linear)
    ET.SubElement(inertial, "origin", xyz=mjcf.numbers(*centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=mjcf.numbers(mass))
    moments = {"ixx": moment, "ixy": 0.0, "ixz": 0.0, "iyy": moment, "iyz": 0.0, "izz": moment}
    ET.SubElement(inertial, "inertia", {key: mjcf.numbers(value) for key, value in moments.items()})
    joint = ET.SubElement(root, "joint", name=name, type="prismatic" if linear else "continuous")
    ET.SubElement(joint, "parent", link="base")
    ET.SubElement(joint, "child", link=f"{name}_link")
    ET.SubElement(joint, "axis", xyz="1 0 0" if linear else "0 1 0")
    effort = model.torque_saturation.limit if model.torque_saturation else _NO_LIMIT
    limit = {"effort": mjcf.numbers(effort), "velocity": mjcf.numbers(_NO_LIMIT)}
    if linear:
        limit |= {"lower": mjcf.numbers(-_FAR_M), "upper": mjcf.numbers(_FAR_M)}
    ET.SubElement(joint, "limit", limit)
    assert model.friction.kind == "coulomb_viscous"
    friction = {"damping": mjcf.numbers(model.friction.viscous), "friction": mjcf.numbers(model.friction.coulomb)}
    ET.SubElement(joint, "dynamics", friction)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"
