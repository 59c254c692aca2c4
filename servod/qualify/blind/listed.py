"""The names on the outside contract's list of effects, which are also the keys of their groups in an axis model file.

Under the drawings and the mix of a trial. The trial has names of its own: it knows nothing of the diagnosis it judges.
"""

from __future__ import annotations

ASYMMETRY = "asymmetry"
STRIBECK = "stribeck"
PRESLIDING = "presliding"
VISCOUS_NONLINEAR = "viscous_nonlinear"
LOAD_DEPENDENT_FRICTION = "load_dependent_friction"
POSITION_DEPENDENT_FRICTION = "position_dependent_friction"
COGGING = "cogging"
TORQUE_RIPPLE = "torque_ripple"
GRAVITY = "gravity"
SPRING = "spring"
BACKLASH = "backlash"
JOINT_ELASTICITY = "joint_elasticity"
TORQUE_GAIN = "torque_gain"
TORQUE_SATURATION = "torque_saturation"
DELAY = "delay"
ACTUATOR_LAG = "actuator_lag"
THERMAL = "thermal"
INERTIA = "inertia"
POSITION_DEPENDENT_INERTIA = "position_dependent_inertia"
ENCODER_ECCENTRICITY = "encoder_eccentricity"
TORQUE_OFFSET = "torque_offset"
DISTURBANCE = "disturbance"
