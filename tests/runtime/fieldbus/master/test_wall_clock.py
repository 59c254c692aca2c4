"""Master and scan over the virtual bus's socket in wall time, with the reader thread: as the daemon runs them."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from rig import JOINT
from witness import axis_config

from servod.cli.app import run
from servod.common.clock import WallClock
from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.main import HubServer, Timing
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import World
from servod.formats.config import AxisConfig
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.cia import NmtCommand, Obj406
from servod.runtime.fieldbus.master import Master, NodeEvent
from servod.runtime.fieldbus.master.scan import scan


@pytest.fixture
def config(tmp_path: Path) -> Iterator[AxisConfig]:
    """The virtual axis at a socket; the configuration that reaches it."""
    path = tmp_path / "bus"
    world = World(VirtualAxisSettings(), AxisModel.model_validate(JOINT))
    server = HubServer(world, path, Timing.STAMPED)
    world.devices.power_on(time.monotonic_ns())
    thread = threading.Thread(target=server.run)
    thread.start()
    yield axis_config(bus={"interface": "virtual", "channel": str(path)})
    server.stop()
    thread.join()
    server.close()


def events_until(master: Master, fault: FaultCode, limit_s: float = 2.0) -> list[NodeEvent]:
    seen: list[NodeEvent] = []
    end = time.monotonic() + limit_s
    while time.monotonic() < end and fault not in {event.fault for event in seen}:
        master.poll()
        seen += master.events()
        time.sleep(0.005)
    return seen


def test_bring_up_watch_and_end(config: AxisConfig) -> None:
    master = Master(config, open_bus(config.bus), WallClock(), threaded=True)
    try:
        assert master.bring_up().bus_load < 0.5
        assert events_until(master, FaultCode.DRIVE_FAULT, 0.2) == []
        other = open_bus(config.bus)
        other.send(0, bytes((NmtCommand.RESET_NODE, 1)))
        assert events_until(master, FaultCode.DRIVE_RESET)[-1].node_id == 1
        other.close()
    finally:
        master.close()
    assert not any(thread.name == "canopen-reader" for thread in threading.enumerate())


def test_a_silent_node_is_lost(config: AxisConfig) -> None:
    master = Master(config, open_bus(config.bus), WallClock(), threaded=True)
    try:
        master.bring_up()
        bus = open_bus(config.bus)
        bus.inject(BusFault(FaultKind.SILENT, amount=1000, participant=2))  # type: ignore[attr-defined]
        assert events_until(master, FaultCode.NODE_HEARTBEAT_LOST)[-1].node_id == 2
        bus.close()
    finally:
        master.close()


def test_a_bus_that_is_off_is_named(config: AxisConfig) -> None:
    bus = open_bus(config.bus)
    master = Master(config, bus, WallClock(), threaded=True)
    try:
        bus.inject(BusFault(FaultKind.BUS_OFF))  # type: ignore[attr-defined]
        end = time.monotonic() + 1.0
        while not bus.counters.bus_off and time.monotonic() < end:
            time.sleep(0.005)
        with pytest.raises(Unreachable, match=r"^bus: frame 0x601 could not be sent \(bus-off\)$"):
            master.bring_up()
    finally:
        master.close()


@pytest.mark.parametrize("threaded", [True, False])
def test_scan_finds_both(config: AxisConfig, threaded: bool) -> None:
    found = scan(open_bus(config.bus), WallClock(), threaded)
    assert [(node.node_id, node.identity.profile) for node in found if node.identity] == [(1, 402), (2, 406)]


def test_servoctl_preset_sets_the_zero_where_no_daemon_runs(
    config: AxisConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, sections = tmp_path / "axis.yaml", config.model_dump(mode="json")
    file.write_text(yaml.safe_dump(sections | {"control": {"socket": str(tmp_path / "axis.sock")}}))
    assert run(["preset", str(file), "--position-rad", "0.5"]) == 0, capsys.readouterr().err
    counts = round(0.5 / (2 * math.pi) * 2**20)
    assert capsys.readouterr().out == f"encoder node 2 reads 0.5 rad here (0x6003 = {counts})\n"
    assert run(["preset", str(file), "--position-rad", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "node_id": 2,
        "position_rad": pytest.approx(0.5, abs=2 * math.pi / 2**20),
        "counts": counts,
    }
    master = Master(config, open_bus(config.bus), WallClock(), threaded=False)
    assert master.sdo(2).read(Obj406.POSITION) == pytest.approx(counts, abs=20)
    master.close()
