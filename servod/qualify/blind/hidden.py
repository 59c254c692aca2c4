"""What an axis of the trial may conceal: every name of the outside contract, in a textbook form and in another one.

Stands on axes and physics. `HIDE` maps a name to the function that draws it; the drawings stand in `hidden_friction`,
`hidden_place` and `hidden_drive`, physics that is on nobody's list in `unlisted`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from servod.qualify.blind import hidden_drive, hidden_place, listed
from servod.qualify.blind.concealed import NO_THERMOMETER, Concealed, Draw

# Draws concealed friction: by direction, near rest, over speed, load and temperature.
#
# Beside `hidden_place` and `hidden_drive`; sizes are shares of Coulomb friction.


def asymmetry(draw: Draw) -> Concealed:
    """Both kinds of friction differ by direction; otherwise dry or viscous friction alone."""
    share = min(draw.size(0.05, 0.2), 0.6) * draw.sign()
    front, back = (1.0 + share, 1.0 - share) if draw.flip() else (1.0, (1.0 - share) / (1.0 + share))
    dry, viscous = (True, True) if not draw.other else (True, False)
    changes = {"front_dry": front if dry else 1.0, "back_dry": back if dry else 1.0}
    changes |= {"front_viscous": front if viscous else 1.0, "back_viscous": back if viscous else 1.0}
    names = {"positive_dry": "front_dry", "negative_dry": "back_dry"}
    names |= {"positive_viscous": "front_viscous", "negative_viscous": "back_viscous"}
    group = {key: changes[own] for key, own in names.items()}
    return Concealed(changes, {"negative_over_positive": back / front}, {listed.ASYMMETRY: group})


def stribeck(draw: Draw) -> Concealed:
    """Friction falls as the axis sets off, where the model's is flat; otherwise by another exponent."""
    p = draw.physics
    excess = min(draw.size(0.4, 0.9), 2.5)
    exponent = draw.one_of(1.0, 0.7, 3.0) if draw.other else 2.0
    static, velocity = p.coulomb * (1.0 + excess), p.stribeck_velocity * draw.between(0.7, 1.4)
    changes = {"static": static, "stribeck_velocity": velocity, "stribeck_exponent": exponent}
    group = {"static": static, "stribeck_velocity": velocity, "exponent": exponent}
    parameters = {"static": static, "stribeck_velocity": velocity} | ({"exponent": exponent} if draw.other else {})
    return Concealed(changes, parameters, {listed.STRIBECK: group}, {"static": p.coulomb})


def presliding(draw: Draw) -> Concealed:
    """The bristle is softer or stiffer than believed; otherwise it also holds without creeping (elasto-plastic)."""
    p = draw.physics
    factor = 2.0 + min(draw.size(0.8, 3.0), 8.0)
    stiffer = draw.between(0.0, 1.0) < 0.4
    sigma0 = p.sigma0 * (factor if stiffer else 1.0 / factor)
    sigma1 = p.sigma1 * (1.0 if draw.flip() else factor**0.5 if stiffer else factor**-0.5)
    changes = {"sigma0": sigma0, "sigma1": sigma1, "elastic_share": 0.6 if draw.other else 0.0}
    found = {"sigma0": sigma0, "sigma1": sigma1}
    believed = {"sigma0": p.sigma0, "sigma1": p.sigma1}
    return Concealed(changes, found, None if draw.other else {listed.PRESLIDING: found}, believed)


def viscous_nonlinear(draw: Draw) -> Concealed:
    """A quadratic drag; otherwise a cubic one or one that thins out."""
    p, speed = draw.physics, draw.axis.speed
    torque = draw.size(0.2, 0.8) * (p.coulomb + 0.4 * p.viscous * speed)
    exponent = draw.one_of(3.0, 0.5, 2.5) if draw.other else 2.0
    changes = {"drag_torque": torque, "drag_speed": speed, "drag_exponent": exponent}
    coefficient = torque / speed**exponent
    key = {2.0: "quadratic", 3.0: "cubic"}.get(exponent, "power")
    group = {key: coefficient} | ({"exponent": exponent} if key == "power" else {})
    return Concealed(changes, group, {listed.VISCOUS_NONLINEAR: group})


def load_dependent_friction(draw: Draw) -> Concealed:
    """Friction per torque of the drive; otherwise per torque of the load, when there is a weight."""
    share = min(draw.size(0.05, 0.2), 0.6)
    if draw.other and draw.physics.gravity > 0.0:
        share = min(2.0 * share, 0.8)
        return Concealed(
            {"dry_per_load": share}, {"per_load": share}, {listed.LOAD_DEPENDENT_FRICTION: {"per_load": share}}
        )
    found = {"per_command": share}
    return Concealed({"dry_per_torque": share}, found, {listed.LOAD_DEPENDENT_FRICTION: found})


def thermal(draw: Draw) -> Concealed:
    """Friction falls exponentially as the joint warms; otherwise in a straight line, or nobody recorded how warm."""
    viscous, dry = min(draw.size(0.02, 0.05), 0.12), min(draw.size(0.012, 0.03), 0.08)
    straight, blind = draw.other and draw.flip(), draw.between(0.0, 1.0) < NO_THERMOMETER
    changes = {"warm_dry": dry, "warm_viscous": viscous, "warm_shape": 0.0 if straight else 1.0}
    shape = "linear" if straight else "exponential"
    found = {"dry_per_c": -dry, "viscous_per_c": -viscous}
    if blind:
        return Concealed(changes, {}, None, thermometer=False, cold=draw.flip())
    return Concealed(changes, found, {listed.THERMAL: {**found, "shape": shape}}, thermometer=True)


# Draws physics that is on nobody's list: the right answer is that something unexplained is there, and where.
#
# Beside the drawings of `hidden_friction`, `hidden_place` and `hidden_drive`.


def cage_resonance(draw: Draw) -> Concealed:
    """Friction that peaks in a band of speeds."""
    speed = draw.between(0.25, 0.5) * draw.axis.speed
    torque = draw.size(0.5, 1.0) * draw.physics.coulomb * 1.2
    return Concealed({"peak_torque": torque, "peak_speed": speed, "peak_width": 0.18 * speed})


def ageing_contacts(draw: Draw) -> Concealed:
    """Friction that grows with the time at rest and is forgotten in motion, which takes time too."""
    return Concealed({"ageing": draw.size(0.6, 1.2), "ageing_s": draw.between(0.15, 0.4)})


def relaxing_spring(draw: Draw) -> Concealed:
    """A belt that creeps: a spring whose rest position follows within a second."""
    stiffness = draw.size(0.8, 1.6) * draw.physics.coulomb / draw.axis.motions.travel
    return Concealed({"relaxing": stiffness, "relaxing_s": draw.between(0.3, 1.0)})


def chaotic_load(draw: Draw) -> Concealed:
    """A load that swings by itself and never repeats."""
    return Concealed({"chaos": draw.size(0.3, 0.7) * draw.physics.coulomb, "chaos_rate": draw.between(0.6, 1.5)})


def travelled_way(draw: Draw) -> Concealed:
    """Friction with a period in the way travelled: balls that recirculate."""
    return Concealed({"way_share": min(draw.size(0.3, 0.5), 0.9), "way_length": draw.between(0.45, 0.9)})


def patchy_friction(draw: Draw) -> Concealed:
    """Friction that jumps between two levels at times of its own."""
    return Concealed({"patchy_share": draw.size(0.25, 0.5), "patchy_s": draw.between(0.3, 0.8)})


#: Draws what is concealed on an axis.
Hide = Callable[[Draw], Concealed]

HIDE: Mapping[str, Hide] = {
    listed.ASYMMETRY: asymmetry,
    listed.STRIBECK: stribeck,
    listed.PRESLIDING: presliding,
    listed.VISCOUS_NONLINEAR: viscous_nonlinear,
    listed.LOAD_DEPENDENT_FRICTION: load_dependent_friction,
    listed.POSITION_DEPENDENT_FRICTION: hidden_place.position_dependent_friction,
    listed.COGGING: hidden_place.cogging,
    listed.TORQUE_RIPPLE: hidden_place.torque_ripple,
    listed.GRAVITY: hidden_place.gravity,
    listed.SPRING: hidden_place.spring,
    listed.BACKLASH: hidden_drive.backlash,
    listed.JOINT_ELASTICITY: hidden_drive.joint_elasticity,
    listed.TORQUE_GAIN: hidden_drive.torque_gain,
    listed.TORQUE_SATURATION: hidden_drive.torque_saturation,
    listed.DELAY: hidden_drive.delay,
    listed.ACTUATOR_LAG: hidden_drive.actuator_lag,
    listed.THERMAL: thermal,
    listed.INERTIA: hidden_drive.inertia,
    listed.POSITION_DEPENDENT_INERTIA: hidden_place.position_dependent_inertia,
    listed.ENCODER_ECCENTRICITY: hidden_place.encoder_eccentricity,
    listed.TORQUE_OFFSET: hidden_drive.torque_offset,
    listed.DISTURBANCE: hidden_drive.disturbance,
}

UNLISTED: Mapping[str, Hide] = {
    "cage_resonance": cage_resonance,
    "ageing_contacts": ageing_contacts,
    "relaxing_spring": relaxing_spring,
    "chaotic_load": chaotic_load,
    "travelled_way": travelled_way,
    "patchy_friction": patchy_friction,
}
