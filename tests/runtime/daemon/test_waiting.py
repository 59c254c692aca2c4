"""A daemon that waits: for bus and nodes at its start, and for their return. It comes back disabled, and remembers."""

from __future__ import annotations

import contextlib
import signal
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from subprocess import Popen
from types import SimpleNamespace
from typing import Any, cast

import pytest
from running import CONFIG, told_to, wait_for

from servod.client.control import ControlClient, Refused
from servod.client.processes import child, wait_until
from servod.common.errors import Unreachable
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.formats.config import AxisConfig
from servod.formats.recording.record import CycleRecord
from servod.qualify.faults.wire import HubWire, at_the_hub
from servod.runtime.daemon.waiting import SHOWN_S, Comeback, carried_by, shown_s_after
from servod.runtime.fieldbus.cia import NmtCommand
from servod.runtime.loop.axis_state import AxisState
from tests.starved import LOGS


class Service:
    """The daemon as its unit runs it, and the virtual axis that comes and goes."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack) -> None:
        self.folder, self._stack, self._starts = folder, stack, 0
        self.manager = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK))
        self.manager.bind(str(folder / "notify"))
        config = CONFIG.format(folder=folder, gains=shipped("gains/demo_pd.yaml"), travel_rad=0.6)
        (folder / "axis.yaml").write_text(config)
        LOGS.append(folder / "daemon.log")
        stack.enter_context(told_to(folder / "notify"))
        arguments = ["--wait", "--config", str(folder / "axis.yaml")]
        self.daemon = stack.enter_context(child("servod.runtime.daemon.main", arguments, folder / "daemon.log"))

    def axis(self) -> Popen[bytes]:
        self._starts += 1
        log, bus = self.folder / f"axis-{self._starts}.log", self.folder / "bus"
        bus.unlink(missing_ok=True)
        axis = self._stack.enter_context(child("servod.drivers.virtual.main", ["--socket", str(bus)], log))
        wait_until(bus.exists, axis, log, 30.0)
        return axis

    def told(self) -> list[str]:
        """All that the manager was told since the last call."""
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self.manager.recv(4096).decode())
        return found

    @property
    def log(self) -> str:
        return (self.folder / "daemon.log").read_text()

    def ask(self, verb: str, **args: Any) -> dict[str, Any]:
        with ControlClient(self.folder / "axis.sock", timeout_s=20.0) as client:
            return client.call(verb, **args)

    def comes_to(self, state: str, *faults: str) -> None:
        """Wait until the axis is there, with these faults shown and no other."""
        self.wait_until(lambda s: s["axis"]["state"] == state and {f["code"] for f in s["faults"]} >= set(faults))

    def wait_until(self, reached: Callable[[dict[str, Any]], bool]) -> None:
        def there() -> bool:
            assert self.daemon.poll() is None, self.log
            try:
                return reached(self.ask("status"))
            except (Unreachable, Refused):
                return False

        wait_for(there, 30.0)


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with contextlib.ExitStack() as stack:
        yield Service(tmp_path, stack)


def test_late_axis_is_waited_for_and_told(service: Service) -> None:
    wait_for((service.folder / "axis.sock").exists, 20.0)
    with pytest.raises((Unreachable, Refused), match=r"waits for bus and nodes, \d+ s so far: .*it begins by itself"):
        service.ask("status")
    assert service.ask("faults")["incidents"] == []
    told: list[str] = []
    wait_for(lambda: bool(told.extend(service.told()) or told))
    assert all("STATUS=waits for bus and nodes" in line and "EXTEND_TIMEOUT_USEC=" in line for line in told)
    service.axis()
    service.comes_to("DISABLED")
    assert service.log.count("waiting for bus and nodes") == 1  # the same reason is told once
    assert any(line.startswith("READY=1") for line in service.told())


def test_waiting_daemon_ends_at_once_when_it_is_asked_to(service: Service) -> None:
    wait_for((service.folder / "axis.sock").exists, 20.0)
    service.daemon.send_signal(signal.SIGTERM)
    assert service.daemon.wait(5.0) == 130
    assert not (service.folder / "axis.sock").exists()


def _moving(service: Service) -> None:
    service.comes_to("DISABLED")
    with ControlClient(service.folder / "axis.sock") as client:
        client.call("enable")
        client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1, duration_s=60, renew_s=None)
    service.comes_to("ENABLED")


def _began_anew(service: Service) -> list[str]:
    """Wait until the axis in FAULT has, and see that it was not enabled; the faults in the daemon's memory."""
    states = set()
    deadline = time.monotonic() + 30.0
    while "bringing the axis up again" not in service.log:
        assert time.monotonic() < deadline, service.log
        with contextlib.suppress(Unreachable, Refused):
            states.add(service.ask("status")["axis"]["state"])
        time.sleep(0.05)
    assert "FAULT" in states and "ENABLED" not in states
    service.wait_until(lambda s: s["axis"]["state"] == "DISABLED" and not s["faults"])
    return [seen["code"] for incident in service.ask("faults")["incidents"] for seen in incident["faults"]]


def test_supply_that_comes_back_brings_the_axis_back_disabled(service: Service) -> None:
    axis = service.axis()
    _moving(service)
    at_first = _shared_memories(service)
    axis.kill()
    service.comes_to("FAULT", "BUS_DOWN")
    time.sleep(SHOWN_S + 1.0)
    service.comes_to("FAULT", "BUS_DOWN")  # nothing is back: the fault goes on to be shown
    service.axis()
    assert "BUS_DOWN" in _began_anew(service)
    assert _shared_memories(service) == at_first, "one that began again a thousand times would have no descriptor left"
    assert service.ask("enable", reset_fault=False)["state"] == "ENABLED"
    service.ask("disable")
    service.daemon.send_signal(signal.SIGTERM)
    assert service.daemon.wait(10.0) == 0


def _shared_memories(service: Service) -> int:
    """Those that the daemon has open."""
    names = []
    for file in Path(f"/proc/{service.daemon.pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            names.append(str(file.readlink()))
    return sum("servod-channel" in name for name in names)


def test_supply_that_goes_and_comes_while_the_axis_is_off_is_no_matter_for_a_person(service: Service) -> None:
    axis = service.axis()
    service.comes_to("DISABLED")
    axis.kill()
    service.comes_to("DISABLED", "NODE_HEARTBEAT_LOST")
    service.axis()
    service.wait_until(lambda s: not s["faults"] and s["uptime_s"] < SHOWN_S)
    assert service.ask("enable")["state"] == "ENABLED"
    service.ask("disable")


def test_drive_that_was_dead_for_a_while_comes_back_disabled(service: Service) -> None:
    service.axis()
    _moving(service)
    with at_the_hub(HubWire(service.folder), CUT_OFF) as hub:
        hub.inject(CUT_OFF)
        hub.happened(CUT_OFF)
    service.comes_to("FAULT", "NODE_HEARTBEAT_LOST")
    assert {"FEEDBACK_STALE", "NODE_HEARTBEAT_LOST"} <= set(_began_anew(service))


CUT_OFF = BusFault(FaultKind.SILENT, amount=1500, participant=1)


def _seen(comeback: Comeback, latched: int, second: float) -> None:
    record = SimpleNamespace(faults=latched, faults_latched=latched, axis_state=AxisState.FAULT)
    comeback.see(cast(CycleRecord, record), round(second * 1e9))


@pytest.mark.parametrize(("gap_s", "stays"), [(0.1, False), (3.0, True)])
def test_an_alarm_of_long_before_the_loss_stays_and_one_that_the_loss_brings_goes(gap_s: float, stays: bool) -> None:
    """An encoder that dies takes its alarm word with it; an alarm that stood there was no part of that."""
    comeback = Comeback(cast(AxisConfig, None), cast(Executor, None), lambda bus: bus)
    alarm, loss = (FAULTS[code].bit for code in (FaultCode.ENCODER_ALARM, FaultCode.NODE_HEARTBEAT_LOST))
    for tenth in range(50):
        _seen(comeback, 0, 10.0 + 0.1 * tenth)
    for tenth in range(round(10 * gap_s)):
        _seen(comeback, alarm, 15.0 + 0.1 * tenth)
    _seen(comeback, alarm | loss, 15.0 + gap_s)
    assert bool(carried_by(alarm | loss, comeback.before) & alarm) is stays


def test_an_alarm_that_nobody_acknowledged_outlives_a_loss_right_after_the_new_beginning() -> None:
    alarm, loss = (FAULTS[code].bit for code in (FaultCode.ENCODER_ALARM, FaultCode.NODE_HEARTBEAT_LOST))
    comeback = Comeback(cast(AxisConfig, None), cast(Executor, None), lambda bus: bus, carried=alarm)
    _seen(comeback, alarm, 10.0)
    _seen(comeback, alarm | loss, 10.8)
    assert carried_by(alarm | loss, comeback.before) == alarm


def test_loss_of_a_node_acknowledges_no_sign_of_a_stranger(service: Service) -> None:
    service.axis()
    service.comes_to("DISABLED")
    with at_the_hub(HubWire(service.folder), NOBODY) as stranger:
        stranger.send(0x601, bytes.fromhex("2b 72 60 00 e8 03 00 00"))  # 0x6072
        service.comes_to("DISABLED", "FOREIGN_SDO")
        stranger.send(0x000, bytes((NmtCommand.RESET_NODE, 1)))
        service.comes_to("DISABLED", "FOREIGN_SDO", "SECOND_MASTER", "DRIVE_RESET")
    service.wait_until(lambda s: s["axis"]["state"] == "FAULT" and s["uptime_s"] < SHOWN_S)
    latched = {fault["code"] for fault in service.ask("status")["faults"]}
    assert latched - {"GUARD_CHANGED", "DEADLINE_LATE"} == {
        "FOREIGN_SDO",
        "SECOND_MASTER",
    }  # what it wrote may be a guard
    assert "still latched from before" in service.log
    with pytest.raises(Refused, match="a fault is latched"):
        service.ask("enable")
    assert service.ask("enable", reset_fault=True)["state"] == "ENABLED"
    service.ask("disable")


NOBODY = BusFault(FaultKind.CLEAR)


def test_drive_that_answers_before_it_can_be_set_up_is_waited_for(service: Service) -> None:
    wait_for((service.folder / "axis.sock").exists, 20.0)
    service.daemon.send_signal(signal.SIGSTOP)
    service.axis()
    with at_the_hub(HubWire(service.folder), DEAF_TO_NMT) as hub:
        hub.inject(DEAF_TO_NMT)
        hub.happened(DEAF_TO_NMT)
        service.daemon.send_signal(signal.SIGCONT)
        service.comes_to("DISABLED")
        assert hub.happened(DEAF_TO_NMT) == DEAF_TO_NMT.amount
    assert service.log.count("waiting for bus and nodes") >= 2, service.log


DEAF_TO_NMT = BusFault(FaultKind.DROP, 0x000, amount=5)


def test_fault_that_comes_back_at_once_is_shown_for_longer_each_time() -> None:
    shown = [SHOWN_S]
    for _ in range(6):
        shown.append(shown_s_after(shown[-1], 1.0 + shown[-1]))
    assert shown == [2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    assert shown_s_after(60.0, 200.0) == SHOWN_S
