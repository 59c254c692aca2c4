"""What the test of the wiring may expect of the joint, filled into a configuration from the axis model that it names.

Beside the data path; the loop gets numbers and reads no file.
"""

from __future__ import annotations

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.model.axis_model import AxisKind, AxisModel, load_axis_model


def with_expected(config: AxisConfig) -> AxisConfig:
    """`config` with wiring_proof.friction_nm and inertia of its `model`, where it does not state them itself.

    Raises BadInput when the model file cannot be read, and when the joint that it tells of needs more torque to move
    than the test may use.
    """
    proof = config.wiring_proof
    if config.model is None or (proof.friction_nm is not None and proof.inertia is not None):
        return config
    model = load_axis_model(config.model)
    if model.axis is not AxisKind.ROTARY:
        return config
    friction_nm = break_away_nm(model) if proof.friction_nm is None else proof.friction_nm
    if friction_nm >= config.most_proof_nm:
        if not proof.enabled:
            return config
        allowed = f"less than the {config.most_proof_nm:.3g} N*m that the test of the wiring may use"
        raise BadInput(f"{config.model}: friction", f"{friction_nm:.3g} N*m at break-away", allowed)
    expected = {
        "friction_nm": friction_nm,
        "inertia": model.inertia if proof.inertia is None else proof.inertia,
    }
    return config.model_copy(update={"wiring_proof": proof.model_copy(update=expected)})


def warnings(config: AxisConfig) -> list[str]:
    """What the test of the wiring will leave unproven on an axis of `config` (after `with_expected`), for the log."""
    proof = config.wiring_proof
    if not proof.enabled:
        return [
            "wiring_proof.enabled is false: the first torque comes unproven; a wrong polarity, scale or direction runs "
            "into the limits"
        ]
    if proof.friction_nm is None or proof.inertia is None:
        return [
            "neither `model` nor wiring_proof.friction_nm and inertia are stated: the proof of the wiring will not "
            "judge the scale of the torque sharply"
        ]
    return []


def break_away_nm(model: AxisModel) -> float:
    """Torque that sets a resting joint in motion, without any load: static friction, or what the law has for it."""
    friction = model.friction
    if friction.kind == "local":
        return max(abs(torque) for torque in friction.torques)
    static = None if friction.kind == "coulomb_viscous" else friction.static
    return friction.coulomb if static is None else static
