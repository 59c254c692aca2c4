"""The daemon against clients and nodes that misbehave, with loop, bus and drive behind it."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from running import CONFIG, Running, SharedAxis, running, wait_for

from servod.client.control import ControlClient, Refused
from servod.client.processes import child, wait_until
from servod.common.errors import Unreachable
from servod.common.shipped import shipped
from servod.drivers.virtual.client import VirtualBus
from servod.runtime.fieldbus.cia import decode_status_word
from servod.runtime.fieldbus.devices import DriveState

AMPLIFIER, ENCODER = 1, 2


@pytest.fixture
def client(axis: Running) -> Iterator[ControlClient]:
    with ControlClient(axis.socket) as client:
        client.call("enable", reset_fault=True)
        yield client
        client.call("disable")


def _state(client: ControlClient) -> dict[str, Any]:
    return client.call("status")


def test_single_bytes_do_not_make_the_loop_look_dead(axis: Running, client: ControlClient) -> None:
    with socket.socket(socket.AF_UNIX) as flood:
        flood.connect(str(axis.socket))
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            flood.send(b"\n")
    time.sleep(0.1)
    assert _state(client)["axis"]["state"] == "ENABLED"
    assert "it hung" not in axis.log


def test_stopped_supervisor_does_not_blame_the_loop(tmp_path: Path) -> None:
    with running(tmp_path) as axis:
        axis.daemon.send_signal(signal.SIGSTOP)
        time.sleep(1.5)
        axis.daemon.send_signal(signal.SIGCONT)
        assert axis.daemon.wait(10) == 3
        assert "it ended in order by itself, told by a signal or since this process stood still" in axis.log
        assert "it hung" not in axis.log


def test_heartbeat_of_no_known_state_is_shown_and_a_fault_and_kills_nobody(tmp_path: Path) -> None:
    with running(tmp_path) as axis, ControlClient(axis.socket) as client, ControlClient(axis.socket) as watcher:
        client.call("enable")
        bus = VirtualBus(str(axis.folder / "bus"))

        def shown() -> bool:
            bus.send(0x700 + ENCODER, b"\x02")
            return "unknown state 2" in {node["state"] for node in _state(client)["nodes"]}

        watch = watcher.watch(0.02)
        wait_for(shown)
        assert next(watch)
        wait_for(lambda: "DUPLICATE_NODE" in {fault["code"] for fault in _state(client)["faults"]})
        bus.close()
        assert axis.daemon.poll() is None


def test_long_motion_comes_in_pieces_and_leaves_the_loop_alone(client: ControlClient) -> None:
    way = [0.01 * (1 - math.cos(2 * math.pi * k / 2500)) for k in range(100_000)]
    assert client.call("track", kind="csv", positions_rad=way)["duration_s"] == pytest.approx(99.999)
    wait_for(lambda: _state(client)["motion"]["reference_rad"] > 0.005)
    assert _state(client)["axis"]["state"] == "ENABLED"
    with pytest.raises(Unreachable, match="a motion is running"):
        client.call("track", kind="csv", positions_rad=way[:3000])
    client.call("stop")


def test_flood_of_commands_leaves_room_for_a_stop(axis: Running) -> None:
    with socket.socket(socket.AF_UNIX) as flood, ControlClient(axis.socket) as other:
        flood.connect(str(axis.socket))
        for verb, args in (("enable", {"reset_fault": True}), ("track", {"kind": "paper", "duration_s": 30})):
            flood.sendall(json.dumps({"id": 1, "verb": verb, "args": args}).encode() + b"\n")
            answer = json.loads(flood.recv(10_000))
            if not answer["ok"]:
                raise Refused(answer["error"])
        for _ in range(5):
            flood.sendall(b'{"id":1,"verb":"halt","args":{"on":true}}\n' * 1000)
        assert other.call("stop")["state"] == "DISABLED"


def test_check_alone_says_what_is_wrong_with_figures(client: ControlClient) -> None:
    with pytest.raises(Unreachable, match=r"position_min_rad to position_max_rad allow -0\.6 to 0\.6"):
        client.call("track", kind="step", amplitude_rad=2.0, duration_s=1, start_immediately=False)
    with pytest.raises(Unreachable, match="speed_rad_s allows 5 rad/s"):
        client.call("track", kind="sine", amplitude_rad=0.2, frequency_hz=10, duration_s=1, start_immediately=False)
    assert client.call("track", kind="paper", duration_s=3, start_immediately=False)["duration_s"] == 3.0
    assert not _state(client)["axis"]["motion_running"]


def test_node_that_was_reset_needs_a_new_start(tmp_path: Path) -> None:
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        client.call("enable")
        bus = VirtualBus(str(tmp_path / "bus"))
        bus.send(0, bytes([129, AMPLIFIER]))
        wait_for(lambda: "DRIVE_RESET" in {fault["code"] for fault in _state(client)["faults"]})
        bus.close()
        with pytest.raises(Unreachable, match="restart the daemon"):
            client.call("enable", reset_fault=True)
        assert axis.daemon.poll() is None
        axis.daemon.send_signal(signal.SIGTERM)
        assert axis.daemon.wait(20) == 3
        assert "0x1016 is left as it is" in axis.log


def test_a_shared_axis_that_needs_a_new_start_is_replaced(tmp_path_factory: pytest.TempPathFactory) -> None:
    with closing(SharedAxis(lambda: running(tmp_path_factory.mktemp("axis")))) as shared:
        first = shared.stands()
        assert shared.stands() is first
        bus = VirtualBus(str(first.folder / "bus"))
        bus.send(0, bytes([129, AMPLIFIER]))
        bus.close()
        with ControlClient(first.socket) as client:
            wait_for(lambda: "DRIVE_RESET" in {fault["code"] for fault in _state(client)["faults"]})
        with pytest.warns(pytest.PytestWarning, match="DRIVE_RESET"):
            assert shared.stands() is not first


def test_drive_that_does_not_hear_is_switched_off_by_sdo(tmp_path: Path) -> None:
    with running(tmp_path) as axis, ControlClient(axis.socket) as client:
        client.call("enable")
        bus = VirtualBus(str(tmp_path / "bus"))
        bus.send(0x600 + AMPLIFIER, bytes([0x23, 0x00, 0x14, 0x01, 0x01, 0x02, 0x00, 0x80]))  # RPDO1 not valid
        wait_for(lambda: "switching it off by SDO" in axis.log)
        bus.close()
        assert "SDO request of somebody else, 23 00 14 01 01 02 00 80 (FOREIGN_SDO)" in axis.log
        assert "DRIVE_STAYS_POWERED" in axis.log
        bus = VirtualBus(str(tmp_path / "bus"))
        assert _drive_state(bus) == DriveState.SWITCH_ON_DISABLED
        assert axis.log.count("switching it off by SDO") == 1
        with pytest.raises(Unreachable, match="restart the daemon"):
            client.call("enable", reset_fault=True)
        bus.close()


def _drive_state(bus: VirtualBus) -> DriveState:
    """0x6041 by SDO, expedited."""
    time.sleep(0.2)  # a drive that was stopped by NMT answers a few cycles later
    deadline, asked = time.monotonic() + 5.0, 0.0
    while time.monotonic() < deadline:
        if (
            time.monotonic() - asked > 0.5
        ):  # one that is NMT stopped still, on a busy machine, hears nothing of the first
            bus.send(0x600 + AMPLIFIER, bytes([0x40, 0x41, 0x60, 0, 0, 0, 0, 0]))
            asked = time.monotonic()
        frame = bus.receive(0.1)
        if frame is not None and frame.can_id == 0x580 + AMPLIFIER and frame.data[1:3] == b"\x41\x60":
            return decode_status_word(int.from_bytes(frame.data[4:6], "little"))
    raise AssertionError("no answer to SDO")


def test_start_that_fails_leaves_no_node_operational(tmp_path: Path) -> None:
    config, bus_path = tmp_path / "axis.yaml", tmp_path / "bus"
    config.write_text(CONFIG.format(folder=tmp_path, gains=shipped("gains/demo_pd.yaml"), travel_rad=0.6))
    (tmp_path / "axis.sock").write_text("precious")
    with child("servod.drivers.virtual.main", ["--socket", str(bus_path)], tmp_path / "axis.log") as virtual:
        wait_until(bus_path.exists, virtual, tmp_path / "axis.log", 30.0)
        command = [sys.executable, "-m", "servod.runtime.daemon.main", "--config", str(config)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 3
        assert "cannot listen there" in done.stderr.splitlines()[-1]
        bus = VirtualBus(str(bus_path))
        assert {_nmt_state(bus, node) for node in (AMPLIFIER, ENCODER)} == {0x7F}
        bus.close()


def _nmt_state(bus: VirtualBus, node_id: int) -> int:
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        frame = bus.receive(0.1)
        if frame is not None and frame.can_id == 0x700 + node_id:
            return frame.data[0]
    raise AssertionError("no heartbeat")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_both_processes_is_an_orderly_end(tmp_path: Path, number: signal.Signals) -> None:
    """By the service manager, and by a terminal that closes."""
    with running(tmp_path) as axis:
        with ControlClient(axis.socket) as client:
            client.call("enable")
            loop = client.call("status")["loop"]["pid"]
        os.kill(loop, number)
        axis.daemon.send_signal(number)
        assert axis.daemon.wait(20) == 0
        assert "LOOP_LOST" not in axis.log
