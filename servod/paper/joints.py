"""The virtual axes that the paper is done on: Table I's joint, and the same joint with what real ones have.

Under the experiments. The paper's laboratory joint is asymmetric, Table I is not; the second joint (the demo's) adds
30 % of asymmetry, cogging, warming and noise, of which no law is told beforehand.
"""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from servod.axis_model import AxisModel, load_axis_model
from servod.config import AxisConfig
from servod.identify.virtual import rated_torque_mnm, virtual_config, virtual_session
from servod.session import SteppedSession
from servod.shipped import shipped

#: Encoder of the paper's runs here; the paper does not print its own.
ENCODER_COUNTS = 2**20
#: Cut-off of the velocity filter under the paper's gain sets, as the demo has it; synthesized sets bring their own.
CUTOFF_HZ = 120.0


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


def config(plant: AxisModel, folder: Path, cutoff_hz: float) -> AxisConfig:
    """The configuration that suits the joint, with the velocity filter of the gain set that is to run."""
    found = virtual_config(folder, rated_torque_mnm(plant), ENCODER_COUNTS)
    encoder = found.encoder.model_copy(update={"velocity_cutoff_hz": cutoff_hz})
    return found.model_copy(update={"encoder": encoder})


def open_session(joint: Joint, folder: Path, seed: int, cutoff_hz: float = CUTOFF_HZ) -> SteppedSession:
    """A session on the virtual axis, SYNC-stepped and disabled."""
    plant = joint.model()
    return virtual_session(plant, folder, ENCODER_COUNTS, seed, config(plant, folder, cutoff_hz))
