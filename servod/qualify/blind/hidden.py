"""What an axis of the trial may conceal: every name of the outside contract, in a textbook form and in another one.

Stands on axes and physics. `HIDE` maps a name to the function that draws it; the drawings stand in `hidden_friction`,
`hidden_place` and `hidden_drive`, physics that is on nobody's list in `unlisted`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from servod.qualify.blind import hidden_drive, hidden_friction, hidden_place, unlisted
from servod.qualify.blind.concealed import Concealed, Draw

#: Draws what is concealed on an axis.
Hide = Callable[[Draw], Concealed]

HIDE: Mapping[str, Hide] = {
    "asymmetry": hidden_friction.asymmetry,
    "stribeck": hidden_friction.stribeck,
    "presliding": hidden_friction.presliding,
    "viscous_nonlinear": hidden_friction.viscous_nonlinear,
    "load_dependent_friction": hidden_friction.load_dependent_friction,
    "position_dependent_friction": hidden_place.position_dependent_friction,
    "cogging": hidden_place.cogging,
    "torque_ripple": hidden_place.torque_ripple,
    "gravity": hidden_place.gravity,
    "spring": hidden_place.spring,
    "backlash": hidden_drive.backlash,
    "joint_elasticity": hidden_drive.joint_elasticity,
    "torque_gain": hidden_drive.torque_gain,
    "torque_saturation": hidden_drive.torque_saturation,
    "delay": hidden_drive.delay,
    "actuator_lag": hidden_drive.actuator_lag,
    "thermal": hidden_friction.thermal,
    "inertia": hidden_drive.inertia,
    "position_dependent_inertia": hidden_place.position_dependent_inertia,
    "encoder_eccentricity": hidden_place.encoder_eccentricity,
    "torque_offset": hidden_drive.torque_offset,
    "disturbance": hidden_drive.disturbance,
}

UNLISTED: Mapping[str, Hide] = {
    "cage_resonance": unlisted.cage_resonance,
    "ageing_contacts": unlisted.ageing_contacts,
    "relaxing_spring": unlisted.relaxing_spring,
    "chaotic_load": unlisted.chaotic_load,
    "travelled_way": unlisted.travelled_way,
    "patchy_friction": unlisted.patchy_friction,
}
