"""What the test of the wiring may expect of the joint, filled into a configuration from the axis model that it names.

Beside the data path; the loop gets numbers and reads no file.
"""

from __future__ import annotations

from servod.axis_model import AxisKind, AxisModel, load_axis_model
from servod.config import AxisConfig


def with_expected(config: AxisConfig) -> AxisConfig:
    """`config` with wiring_proof.friction_nm and inertia of its `model`, where it does not state them itself.

    Raises BadInput when the model file cannot be read.
    """
    proof = config.wiring_proof
    if config.model is None or (proof.friction_nm is not None and proof.inertia is not None):
        return config
    model = load_axis_model(config.model)
    if model.axis is not AxisKind.ROTARY:
        return config
    expected = {
        "friction_nm": break_away_nm(model) if proof.friction_nm is None else proof.friction_nm,
        "inertia": model.inertia if proof.inertia is None else proof.inertia,
    }
    return config.model_copy(update={"wiring_proof": proof.model_copy(update=expected)})


def break_away_nm(model: AxisModel) -> float:
    """Torque that sets a resting joint in motion, without any load: static friction, or what the law has for it."""
    friction = model.friction
    if friction.kind == "local":
        return max(abs(torque) for torque in friction.torques)
    static = None if friction.kind == "coulomb_viscous" else friction.static
    return friction.coulomb if static is None else static
