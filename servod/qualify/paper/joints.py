"""The virtual axes that the paper is done on: Table I's joint, and the same joint with what real ones have.

Under the experiments. The paper's laboratory joint is asymmetric, Table I is not; the second joint (the demo's) adds
30 % of asymmetry, cogging, warming and noise, of which no law is told beforehand.
"""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from servod.client.stepped import SteppedSession
from servod.client.virtual import rated_torque_mnm, virtual_config, virtual_session
from servod.common.shipped import shipped
from servod.formats.model.axis_model import AxisModel, load_axis_model

#: Encoder of the paper's runs here; the paper does not print its own.
ENCODER_COUNTS = 2**20
#: Cut-off of the velocity filter under the paper's gain sets, as the demo has it; synthesized sets bring their own.
CUTOFF_HZ = 120.0
#: Speed limit while gain sets are compared: the gains of Table I turn the joint at 3.6 rad/s after a step of 100 mrad.
STEP_SPEED_RAD_S = 10.0


class Joint(Enum):
    """A virtual joint by the file of its model."""

    TABLE1 = "table1_joint"
    REAL = "demo_joint"

    @property
    def label(self) -> str:
        """What people read."""
        return {"table1_joint": "Table I's joint", "demo_joint": "asymmetric joint"}[self.value]

    def model(self) -> AxisModel:
        """The plant."""
        return load_axis_model(shipped(f"gains/axes/{self.value}.yaml"))


def open_session(joint: Joint, folder: Path, seed: int) -> SteppedSession:
    """A session on the virtual axis for its identification, SYNC-stepped and disabled."""
    return virtual_session(joint.model(), folder, ENCODER_COUNTS, seed)


def open_for_tracking(joint: Joint, folder: Path, seed: int, cutoff_hz: float) -> SteppedSession:
    """The same axis with the velocity filter of the gain set that is to run, and room for the steps of section V."""
    plant = joint.model()
    found = virtual_config(folder, rated_torque_mnm(plant), ENCODER_COUNTS)
    encoder = found.encoder.model_copy(update={"velocity_cutoff_hz": cutoff_hz})
    limits = found.limits.model_copy(update={"speed_rad_s": STEP_SPEED_RAD_S})
    config = found.model_copy(update={"encoder": encoder, "limits": limits})
    return virtual_session(plant, folder, ENCODER_COUNTS, seed, config)
