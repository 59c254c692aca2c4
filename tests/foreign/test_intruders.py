"""CANopenNode as another master on a bus that servod commands: whatever it says there is a fault with a name."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.foreign.canopennode import Gateway, party
from tests.foreign.daemon import configured, daemon, virtual_axis, wait_for

INTRUDER = 100


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        ("1 r 0x6041 0 u16", "FOREIGN_SDO"),
        ("2 w 0x6003 0 u32 5", "FOREIGN_SDO"),
        ("1 stop", "SECOND_MASTER"),
        ("0 preop", "SECOND_MASTER"),
    ],
)
def test_what_another_master_says_stops_the_axis(built: Path, tmp_path: Path, command: str, fault: str) -> None:
    with (
        virtual_axis(tmp_path) as bus,
        daemon(configured(tmp_path)) as (client, _),
        party(built, "canopend", bus, INTRUDER, tmp_path, ("-c", "stdio")) as canopend,
    ):
        client.call("enable")
        client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1.0, duration_s=30.0)
        assert client.call("status")["axis"]["state"] == "ENABLED", "its heartbeat alone is nothing to us"
        Gateway(canopend).ask(command)
        wait_for(lambda: client.call("status")["axis"]["state"] == "FAULT")
        assert fault in {found["code"] for found in client.call("status")["faults"]}


def test_another_device_with_a_node_id_of_the_axis_stops_it(built: Path, tmp_path: Path) -> None:
    with virtual_axis(tmp_path) as bus, daemon(configured(tmp_path)) as (client, _):
        client.call("enable")
        with party(built, "encoder", bus, 2, tmp_path, joint=tmp_path / "joint"):
            wait_for(lambda: client.call("status")["axis"]["state"] == "FAULT")
            assert {found["code"] for found in client.call("status")["faults"]} & {"DUPLICATE_NODE", "DRIVE_RESET"}
