"""What the test of the wiring may expect of the joint, filled into a configuration from the axis model that it names.

Beside the data path; the loop gets numbers and reads no file.
"""

from __future__ import annotations

import math

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.config_wire import QUICK_STOP_STAYS, quick_stop_stays
from servod.formats.model.axis_model import AxisKind, AxisModel, load_axis_model

#: Places within the position limits at which a load is looked at.
_POSITIONS = 200


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
            "wiring_proof.enabled is false: the first torque comes untested; a wrong polarity, scale or direction runs "
            "into the limits"
        ]
    if proof.friction_nm is None or proof.inertia is None:
        return [
            "neither `model` nor wiring_proof.friction_nm and inertia are stated: the wiring test will not "
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


def load_nm(model: AxisModel, config: AxisConfig) -> float:
    """The largest torque that gravity and torque_offset of the model put on the joint within the position limits."""
    low, high = config.limits.position_min_rad, config.limits.position_max_rad
    amplitude, phase = (model.gravity.amplitude, model.gravity.phase) if model.gravity else (0.0, 0.0)
    positions = (low + (high - low) * k / _POSITIONS for k in range(_POSITIONS + 1))
    return max(abs(amplitude * math.sin(position + phase) + model.torque_offset) for position in positions)


def brake_notes(config: AxisConfig) -> list[str]:
    """What may fall on this axis, when, and how far, with the load of the model and no friction to hold it."""
    brake, option = config.amplifier.brake, config.amplifier.quick_stop_option
    model = None if config.model is None else load_axis_model(config.model)
    load = 0.0 if model is None or model.axis is not AxisKind.ROTARY else load_nm(model, config)
    if brake.by == "none":
        if model is None or load <= break_away_nm(model):
            return []
        return [f"a load of {load:.3g} N*m is more than friction holds: it falls when switched off, without a brake"]
    fall = "how far a load falls meanwhile cannot be said without `model`"
    if model is not None:
        fall_rad = 0.5 * load / model.inertia * brake.engage_s**2
        fall = f"a load of {load:.3g} N*m falls up to {fall_rad:.3g} rad meanwhile"
    notes = [
        f"when the drive faults, STO opens or the bus is lost the torque goes at once, and the brake closes after "
        f"{brake.engage_s:g} s (amplifier.brake.engage_s): {fall}"
    ]
    if brake.by == "output":
        dies = (
            "holds the load, the brake open" if quick_stop_stays(option) else "lets go, the brake open: the load falls"
        )
        notes.append(
            f"when this computer dies nobody closes a brake by output: the drive stops by itself and {dies} "
            f"(amplifier.quick_stop_option {option})"
        )
        if not quick_stop_stays(option):
            notes.append(
                f"at a stop amplifier.quick_stop_option {option} lets go when the joint has come to rest, before the "
                f"brake is closed: {fall}; 5 to 8 hold until it is"
            )
    elif option in (0, *range(QUICK_STOP_STAYS, 9)):
        notes.append(
            f"amplifier.quick_stop_option {option}: the drive closes its brake after a stop when it switches off by "
            "itself, with 1 to 4"
        )
    return notes
