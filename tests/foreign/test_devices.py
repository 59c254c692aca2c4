"""CANopenNode as the encoder and the amplifier of an axis: servod brings them up, moves them, and dies."""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Iterator
from pathlib import Path
from subprocess import Popen
from typing import NamedTuple

import pytest

from servod.client.control import ControlClient, Refused
from servod.common.errors import AnswerIsNo
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.client import VirtualBus
from servod.runtime.fieldbus.cia import RPDO_BASE
from tests.foreign.canopennode import Party, party
from tests.foreign.daemon import configured, daemon, virtual_axis, wait_for

AMPLIFIER, ENCODER = 1, 2


class Joint(NamedTuple):
    """What really happened, as the amplifier's program has it."""

    position_rad: float
    speed_rad_s: float
    torque_nm: float
    powered: int


class ForeignAxis:
    """Both devices on the bus; daemons come and go."""

    def __init__(self, folder: Path, amplifier: Party, encoder: Party) -> None:
        self.folder, self.amplifier, self.encoder = folder, amplifier, encoder
        vendor = {"vendor_id": 0xC0DE}
        self.config = configured(
            folder,
            amplifier={"identity": vendor | {"product_code": 402}, "heartbeat_reaction": 1, "quirks": "canopennode"},
            encoder={"identity": vendor | {"product_code": 406}},
        )

    def joint(self) -> Joint:
        """The joint now."""
        return Joint._make(struct.unpack("=dddI", (self.folder / "joint").read_bytes()[:28]))


@pytest.fixture
def axis(built: Path, tmp_path: Path) -> Iterator[ForeignAxis]:
    """The wire is that of a virtual axis whose own nodes stand aside."""
    joint = tmp_path / "joint"
    with (
        virtual_axis(tmp_path, "--amplifier-node-id", "101", "--encoder-node-id", "102") as bus,
        party(built, "encoder", bus, ENCODER, tmp_path, joint=joint) as encoder,
        party(built, "amplifier", bus, AMPLIFIER, tmp_path, joint=joint) as amplifier,
    ):
        yield ForeignAxis(tmp_path, amplifier, encoder)


def enable_and_move(axis: ForeignAxis, client: ControlClient) -> None:
    client.call("enable", reset_fault=True)
    client.call("track", kind="sine", amplitude_rad=0.2, frequency_hz=1.0, duration_s=30.0)
    start_rad = axis.joint().position_rad
    wait_for(lambda: abs(axis.joint().position_rad - start_rad) > 0.1)


def test_servod_brings_them_up_and_moves_them(axis: ForeignAxis) -> None:
    with daemon(axis.config) as (client, _):
        status = client.call("status")
        assert {node["state"] for node in status["nodes"]} == {"OPERATIONAL"}
        assert client.call("enable")["wiring"]["finding"] == "PASSED"
        enable_and_move(axis, client)
        assert client.call("status")["axis"]["state"] == "ENABLED"
        client.call("disable")
        assert axis.joint().powered == 0
    assert axis.joint().torque_nm == 0.0


def faults(client: ControlClient) -> set[str]:
    return {fault["code"] for fault in client.call("status")["faults"]}


def kill(client: ControlClient, daemon: Popen[bytes]) -> None:
    """End the whole master at once, as a crash of its machine does: nothing is sent any more."""
    loop = client.call("status")["loop"]["pid"]
    for pid in (daemon.pid, loop):
        os.kill(pid, signal.SIGSTOP)
    for pid in (loop, daemon.pid):
        os.kill(pid, signal.SIGKILL)
    daemon.wait()


def test_they_stop_by_themselves_when_the_master_dies_and_come_back_by_hand(axis: ForeignAxis) -> None:
    with daemon(axis.config) as (client, process):
        enable_and_move(axis, client)
        kill(client, process)
    wait_for(lambda: not axis.joint().powered, 1.0)
    assert axis.joint().torque_nm == 0.0
    axis.amplifier.wait_for("errorCode=0x8130")
    assert "errorCode=0x8250" not in axis.amplifier.log, "the deadline is looked at when SYNC comes"
    with daemon(axis.config) as (client, _):
        wait_for(lambda: "DRIVE_FAULT" in faults(client))
        assert client.call("status")["drive"]["state"] == "FAULT"
        with pytest.raises(Refused, match="reset-fault"):
            client.call("enable")
        enable_and_move(axis, client)


def test_its_deadline_tells_of_lost_commands_while_sync_comes(axis: ForeignAxis) -> None:
    with daemon(axis.config) as (client, _):
        assert "the heartbeat guards alone: 100 ms" in (axis.folder / "servod.log").read_text()
        bus = VirtualBus(str(axis.folder / "bus"))
        bus.inject(BusFault(FaultKind.DROP, RPDO_BASE[0] + AMPLIFIER, 100_000))
        axis.amplifier.wait_for("errorCode=0x8250")
        bus.inject(BusFault(FaultKind.CLEAR))
        bus.close()
        wait_for(lambda: "DRIVE_FAULT" in faults(client))


@pytest.mark.parametrize("kind", ["encoder", "amplifier"])
def test_the_axis_stops_when_one_of_them_dies_and_goes_on_with_another(
    axis: ForeignAxis, built: Path, kind: str
) -> None:
    dead = getattr(axis, kind)
    with daemon(axis.config) as (client, _):
        enable_and_move(axis, client)
        dead.process.kill()
        wait_for(lambda: client.call("status")["axis"]["state"] == "FAULT")
        assert faults(client) & {"FEEDBACK_STALE", "NODE_HEARTBEAT_LOST"}
        if kind == "encoder":
            wait_for(lambda: not axis.joint().powered)
    node_id = ENCODER if kind == "encoder" else AMPLIFIER
    other = party(built, kind, axis.folder / "bus", node_id, axis.folder, joint=axis.folder / "joint")
    with other, daemon(axis.config) as (client, _):
        enable_and_move(axis, client)


def test_the_test_of_the_wiring_refuses_an_encoder_that_is_not_on_the_joint(built: Path, tmp_path: Path) -> None:
    config = configured(tmp_path)
    with (
        virtual_axis(tmp_path, "--encoder-node-id", "102") as bus,
        party(built, "encoder", bus, ENCODER, tmp_path, joint=tmp_path / "joint"),
        daemon(config) as (client, _),
    ):
        found = {node["node_id"]: node["identity"]["vendor_id"] for node in client.call("scan")["nodes"]}
        assert found[ENCODER] == 0xC0DE
        with pytest.raises(AnswerIsNo, match="wiring test failed"):
            client.call("enable")
        assert "WIRING_NOT_PROVEN" in faults(client)
