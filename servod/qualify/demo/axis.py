"""The demo's axis: one configuration for daemon, loop and stepped session, shipped gain sets, default plant.

Beside the data path. Everything that acts is the product's own; only these values are the demo's.
"""

from __future__ import annotations

from pathlib import Path

from servod.client.processes import last_core, own_group
from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.formats.config import AxisConfig

#: The four laws of the comparison, in the order of the table; each has its gain set `gains/demo_<law>.yaml`.
CONTROLLERS = ("pd", "pd_dob", "pd_lugre", "local")

#: The row after all others on the shipped joint: what identify, synthesize and verify make of it.
CERTIFIED, CERTIFIED_LABEL = "local_certified", "Local models, synthesized and certified"


def gains_file(controller: str) -> Path:
    """The shipped gain set of one law."""
    return shipped(f"gains/demo_{controller}.yaml")


def plant_file(plant: Path | None) -> Path:
    """The axis model that the virtual axis is to be: the one given, or the shipped demo joint."""
    return plant if plant is not None else shipped("gains/axes/demo_joint.yaml")


def demo_config(folder: Path, recordings: Path) -> AxisConfig:
    """Configuration of the demo's axis; sockets and gain store under `folder`, recordings where they shall stay."""
    return validate(
        {
            "name": "demo",
            "bus": {"interface": "virtual", "channel": str(folder / "bus")},
            "cycle": {"cpu": last_core(), "priority": 80},
            "limits": {
                "torque_nm": 0.3,
                "torque_rate_nm_per_s": 200.0,
                "speed_rad_s": 3.0,
                "position_min_rad": -0.6,
                "position_max_rad": 0.6,
                "following_error_rad": 0.15,
                "encoder_mismatch_rad": 0.05,
                # Without real-time rights the virtual axis may wait for its turn; a real drive never does.
                "stale_cycles": 50,
                "late_cycles": 100,
            },
            "gains": {
                "directory": str(folder / "gains"),
                "initial": str(gains_file(CONTROLLERS[0])),
                "accept_uncertified": True,
            },
            "control": {"socket": str(folder / "axis.sock"), "group": own_group()},
            "recorder": {"directory": str(recordings.resolve()), "history_s": 5.0},
        },
        AxisConfig,
        "demo",
    )
