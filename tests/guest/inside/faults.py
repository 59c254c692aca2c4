"""Scenarios of the fault campaign on the installed service: systemd's processes, vcan0, the drive's own record."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from inside.tools import (
    AXIS_UNIT,
    CONFIG,
    DRIVE_RECORD,
    INTERFACE,
    SOCKET,
    UNIT,
    begun_anew,
    journal,
    prop,
    shell,
    status,
    unless_starved,
    wait_for,
)
from servod.common.errors import ServodError
from servod.drivers.virtual.drive_record import DriveSample, read_drive_record
from servod.formats.protocol import Verb
from servod.qualify.faults.machine import Machine, Process
from servod.qualify.faults.processes import ProcessAxis
from servod.qualify.faults.run import run_scenario
from servod.qualify.faults.scenario import Runs, Scenario
from servod.qualify.faults.variants import shipped_scenarios
from servod.qualify.faults.wire import CanWire

#: The longest that a daemon may take to come back by itself or by hand.
_BACK_S = 60.0


class UnitMachine(Machine):
    """The service's processes in place of the campaign's own; what still serves is used again."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, CanWire(INTERFACE))
        self.config, self.socket = folder / "axis.yaml", Path(SOCKET)
        self._joined = _interface_number()
        self._said = len(journal())
        self._earlier: list[DriveSample] = []  # a start of the virtual axis begins its record again

    def start_virtual_axis(self) -> None:
        """Start it, or leave the one that has its place on the bus."""
        if self.alive(Process.VIRTUAL_AXIS):
            return
        self._earlier = self.drive_samples()
        said = journal(AXIS_UNIT).count("ready ")
        shell("systemctl", "restart", AXIS_UNIT)
        wait_for(lambda: journal(AXIS_UNIT).count("ready ") > said, _BACK_S, "the virtual axis")
        self._joined = _interface_number()

    def start_daemon(self) -> None:
        """Bring up a daemon without a fault and with the axis disabled; one that is so already is left."""
        begun_anew()

    def stop_daemon(self) -> None:
        """At once: an orderly end waits for a drive that is not heard any more."""
        shell("systemctl", "kill", "--signal=KILL", UNIT)
        shell("systemctl", "stop", UNIT)

    def alive(self, who: Process) -> bool:
        """Whether it runs; a virtual axis whose interface went away has no place on the bus any more."""
        if who is Process.DAEMON:
            return prop("ActiveState") == "active"
        return prop("ActiveState", AXIS_UNIT) == "active" and _interface_number() == self._joined

    def send(self, who: Sequence[Process], number: signal.Signals) -> None:
        """Signal the main processes, and the loop by its number in the status."""
        pids = [self._pid(process) for process in who]
        if len(who) > 1 and number is signal.SIGKILL:
            for pid in pids:
                os.kill(pid, signal.SIGSTOP)
        for pid in pids:
            os.kill(pid, number)

    def wait(self, who: Process, timeout_s: float) -> int:
        """Exit code of the daemon; the virtual axis is restarted by its unit, whatever became of it."""
        if who is Process.VIRTUAL_AXIS:
            return 0
        wait_for(lambda: prop("ActiveState") in ("inactive", "failed"), timeout_s, "the end")
        return int(prop("ExecMainStatus"))

    def drive_samples(self) -> list[DriveSample]:
        """The drive's own record."""
        return [*self._earlier, *read_drive_record(DRIVE_RECORD)]

    def daemon_log(self) -> str:
        """What the unit said since the scenario began; by a cursor, journalctl of systemd 252 leaves out a line."""
        return journal()[self._said :]

    def close(self) -> None:
        """Leave the axis disabled."""
        with contextlib.suppress(ServodError), self.client() as client:
            client.call(Verb.DISABLE)

    def _pid(self, who: Process) -> int:
        if who is Process.LOOP:
            return int(status()["loop"]["pid"])
        return int(prop("MainPID", UNIT if who is Process.DAEMON else AXIS_UNIT))


def _interface_number() -> int:
    """It is another one when the interface was taken away and made again."""
    path = Path(f"/sys/class/net/{INTERFACE}/ifindex")
    return int(path.read_text()) if path.exists() else 0


def _axis(scenario: Scenario, folder: Path) -> ProcessAxis:
    over = yaml.safe_load(CONFIG)
    over["recorder"]["always"] = False
    return ProcessAxis(scenario, folder, UnitMachine(folder), over)


def campaign() -> dict[str, Any]:
    """Every scenario of the guest: its complaints, or what kept it from running; row by row into SHARE as well."""
    shell("systemctl", "start", UNIT)
    with (Path(sys.argv[1]) / "campaign.jsonl").open("w") as rows:
        outcomes = {}
        for name, scenario in shipped_scenarios().items():
            if scenario.runs is Runs.GUEST:
                outcomes[name] = unless_starved(partial(_outcome, name, scenario), "complaints")
                print(json.dumps({name: outcomes[name]}), file=rows, flush=True)
    return {"scenarios": outcomes}


def _outcome(name: str, scenario: Scenario) -> dict[str, Any]:
    started = time.monotonic()
    try:
        outcome = run_scenario(name, scenario, _axis)
    except Exception as error:
        row: dict[str, Any] = {"complaints": [f"{type(error).__name__}: {error}"]}
    else:
        row = {"detected": outcome.detected, "axis": outcome.axis, "complaints": outcome.complaints}
        row |= {"gone_ms": outcome.reaction.gone_ms, "left_ms": outcome.reaction.left_ms}
        if outcome.complaints:
            row["journal_tail"] = shell("journalctl", "--no-pager", "-n", "30", "-o", "cat")[-4000:]
    return {**row, "seconds": round(time.monotonic() - started, 1)}
