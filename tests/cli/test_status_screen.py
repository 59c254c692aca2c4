"""One screen shows state, goal, reasons, faults, values, timing and refused real-time grants."""

from __future__ import annotations

from typing import Any

import pytest
from rich.console import Console

from servod.cli.status import screen
from servod.common.faults import FAULTS, FaultCode

FAULT = FAULTS[FaultCode.FOLLOWING_ERROR]


def document() -> dict[str, Any]:
    """A status document of an axis that did not get where it should."""
    lag = {"p50_us": 20.0, "p99_us": 60.0, "max_us": 900.0}
    return {
        "name": "joint[3]",
        "axis": {
            "state": "FAULT",
            "goal": "OFF",
            "goal_reached": False,
            "reasons": ["the drive is not ready"],
            "motion_running": False,
        },
        "drive": {"state": "SWITCH_ON_DISABLED", "status_word": "0x0240", "error_code": "0x0000", "mode": 10},
        "motion": {
            "position_rad": 0.25,
            "reference_rad": 0.2,
            "following_error_rad": -0.05,
            "velocity_rad_s": None,
            "torque_nm": 0.0123,
            "torque_friction_nm": 0.0,
        },
        "wiring": {"tests": 1, "last": {"passed": False, "text": "wiring not proven (TORQUE_POLARITY): turn it"}},
        "faults": [
            {
                "code": FAULT.code.name,
                "present": False,
                "reaction": FAULT.reaction.name,
                "cause": FAULT.cause,
                "remedy": FAULT.remedy,
            }
        ],
        "controller": {"serial": 1, "name": "trial", "law": "pd"},
        "timing": {"window_s": 10.0, "cycle": 12345, "missed": 3, "lag": lag, "tick": lag, "torque": lag},
        "bus": {
            "interface": "socketcan",
            "channel": "can0",
            "load": 0.39,
            "max_load": 0.7,
            "queue_full": 0,
            "error_frames": 2,
        },
        "nodes": [{"node_id": 1, "role": "amplifier", "driver": "cia402", "state": "OPERATIONAL"}],
        "grants": [
            {"name": "memory_lock", "granted": True, "reason": ""},
            {"name": "sched_fifo", "granted": False, "reason": "priority 80: Operation not permitted"},
        ],
        "recorder": {"recording": False, "path": "", "records": 0, "failure": ""},
    }


def shown(status: dict[str, Any]) -> str:
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: PTH123, SIM115
    console.print(screen(status))
    return console.export_text()


@pytest.mark.parametrize(
    "text",
    [
        "joint[3] is FAULT, goal OFF not reached: the drive is not ready",
        "status word 0x0240",
        "was FOLLOWING_ERROR (RAMP_DOWN)",
        "+0.2500 rad",
        "-50.0000 mrad",
        "not finite",
        "trial (pd)",
        "39% of 70% allowed",
        "cycle 12345, 3 missed",
        "not granted sched_fifo: priority 80: Operation not permitted",
    ],
)
def test_the_screen_shows(text: str) -> None:
    assert text in shown(document())


def test_it_is_one_screen() -> None:
    assert len(shown(document()).splitlines()) <= 24


def test_granted_requests_are_not_shown() -> None:
    assert "memory_lock" not in shown(document())
