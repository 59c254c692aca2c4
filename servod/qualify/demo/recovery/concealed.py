"""What a virtual axis can conceal: effects of a size that costs tracking, and the model that does not know them.

Beside the data path. Sizes go with the joint's dry friction, so that any joint conceals something that counts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from servod.common.errors import BadInput
from servod.formats.model.axis_model import AxisModel

#: What stands under the effect's key in the axis model file, for a joint of some dry friction in N*m.
CONCEALED: dict[str, Callable[[float], Any]] = {
    "cogging": lambda dry: {"harmonics": [_sine(0.3 * dry, 22.0, 0.7), _sine(0.1 * dry, 44.0, 2.1)]},
    "gravity": lambda dry: {"amplitude": 1.3 * dry, "phase": 0.3},
    "asymmetry": lambda _dry: {"positive_dry": 1.3, "negative_dry": 0.7},
    "spring": lambda dry: {"stiffness": 7.0 * dry, "rest": 0.1},
    "torque_offset": lambda dry: 0.5 * dry,
}

#: What is concealed when nobody says what.
DEFAULT = "gravity"

#: Noise of the demo's joint, where the plant has none of its own.
NOISE = {"torque_rms": 0.0003, "torque_bandwidth_hz": 200.0, "encoder_rms": 2.0e-6}


def _sine(amplitude: float, periods_per_turn: float, phase: float) -> dict[str, float]:
    return {"amplitude": amplitude, "periods_per_turn": periods_per_turn, "phase": phase}


def believed_and_true(plant: AxisModel, effect: str) -> tuple[AxisModel, AxisModel]:
    """The axis without and with the effect. An effect that `plant` has is taken out of what is believed.

    Raises BadInput for an effect that a controller cannot be told of, and that the plant does not have.
    """
    document = plant.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    document.setdefault("noise", NOISE)
    if effect in document:
        without = {key: value for key, value in document.items() if key != effect}
        return AxisModel.model_validate(without), plant
    if effect not in CONCEALED:
        raise BadInput("--conceal", repr(effect), ", ".join(CONCEALED) + ", or an effect that --plant has")
    dry = getattr(plant.friction, "coulomb", 0.0) or 0.05
    return AxisModel.model_validate(document), AxisModel.model_validate(document | {effect: CONCEALED[effect](dry)})
