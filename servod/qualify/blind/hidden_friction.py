"""Draws concealed friction: by direction, near rest, over speed, load and temperature.

Beside `hidden_place` and `hidden_drive`; sizes are shares of Coulomb friction.
"""

from __future__ import annotations

from servod.qualify.blind.concealed import NO_THERMOMETER, Concealed, Draw


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
    return Concealed(changes, {"negative_over_positive": back / front}, {"asymmetry": group})


def stribeck(draw: Draw) -> Concealed:
    """Friction falls as the axis sets off, where the model's is flat; otherwise by another exponent."""
    p = draw.physics
    excess = min(draw.size(0.4, 0.9), 2.5)
    exponent = draw.one_of(1.0, 0.7, 3.0) if draw.other else 2.0
    static, velocity = p.coulomb * (1.0 + excess), p.stribeck_velocity * draw.between(0.7, 1.4)
    changes = {"static": static, "stribeck_velocity": velocity, "stribeck_exponent": exponent}
    group = {"static": static, "stribeck_velocity": velocity, "exponent": exponent}
    parameters = {"static": static, "stribeck_velocity": velocity} | ({"exponent": exponent} if draw.other else {})
    return Concealed(changes, parameters, {"stribeck": group}, {"static": p.coulomb})


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
    return Concealed(changes, found, None if draw.other else {"presliding": found}, believed)


def viscous_nonlinear(draw: Draw) -> Concealed:
    """A quadratic drag; otherwise a cubic one or one that thins out."""
    p, speed = draw.physics, draw.axis.speed
    torque = draw.size(0.2, 0.8) * (p.coulomb + 0.4 * p.viscous * speed)
    exponent = draw.one_of(3.0, 0.5, 2.5) if draw.other else 2.0
    changes = {"drag_torque": torque, "drag_speed": speed, "drag_exponent": exponent}
    coefficient = torque / speed**exponent
    key = {2.0: "quadratic", 3.0: "cubic"}.get(exponent, "power")
    group = {key: coefficient} | ({"exponent": exponent} if key == "power" else {})
    return Concealed(changes, group, {"viscous_nonlinear": group})


def load_dependent_friction(draw: Draw) -> Concealed:
    """Friction per torque of the drive; otherwise per torque of the load, when there is a weight."""
    share = min(draw.size(0.05, 0.2), 0.6)
    if draw.other and draw.physics.gravity > 0.0:
        share = min(2.0 * share, 0.8)
        return Concealed({"dry_per_load": share}, {"per_load": share}, {"load_dependent_friction": {"per_load": share}})
    found = {"per_command": share}
    return Concealed({"dry_per_torque": share}, found, {"load_dependent_friction": found})


def thermal(draw: Draw) -> Concealed:
    """Friction falls exponentially as the joint warms; otherwise in a straight line, or nobody recorded how warm."""
    viscous, dry = min(draw.size(0.02, 0.05), 0.12), min(draw.size(0.012, 0.03), 0.08)
    straight, blind = draw.other and draw.flip(), draw.between(0.0, 1.0) < NO_THERMOMETER
    changes = {"warm_dry": dry, "warm_viscous": viscous, "warm_shape": 0.0 if straight else 1.0}
    shape = "linear" if straight else "exponential"
    found = {"dry_per_c": -dry, "viscous_per_c": -viscous}
    if blind:
        return Concealed(changes, {}, None, thermometer=False, cold=draw.flip())
    return Concealed(changes, found, {"thermal": {**found, "shape": shape}}, thermometer=True)
