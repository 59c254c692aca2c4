"""A machine that loses its power while the axis moves, records, faults and changes gains; and what is there after.

What the daemon has told to be done is written to the host, synced, before the next thing begins: `SHARE/told.jsonl`.
The host kills the machine at any moment; the next start looks whether all of it is still there.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from inside.tools import AXIS_UNIT, CONFIG, GAINS_FILE, INTERFACE, UNIT, client, journal, prop, shell, wait_for
from servod.client.control import ControlClient
from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.gains.store import GainStore
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.record import RECORD, CycleRecord

#: An emergency message of the amplifier: over-current (CiA 301, 7.2.7).
_EMERGENCY = "081#1023010000000000"
_TOLD = Path(sys.argv[1]) / "told.jsonl"


def powered() -> dict[str, Any]:
    """Look at what the last cut left, then work until the next; the file `last` in SHARE is the order to stop."""
    said = [json.loads(line) for line in _TOLD.read_text().splitlines()] if _TOLD.exists() else []
    begun = max((at for at, row in enumerate(said) if "boot" in row), default=len(said))
    config = AxisConfig.model_validate(yaml.safe_load(CONFIG))
    found = {"files": list(_files(said[begun:])), **_store(config, said)} if said else {}
    if said:
        shell("modprobe", "-a", "can-dev", "can", "can-raw", "vcan")
        shell("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
        shell("ip", "link", "set", INTERFACE, "up")
    shell("systemctl", "start", AXIS_UNIT)
    wait_for(lambda: "ready vcan0" in journal(AXIS_UNIT), 240, "the virtual axis")
    shell("systemctl", "start", UNIT)
    wait_for(lambda: prop("ActiveState") == "active", 120, "readiness")
    with client() as connection:
        now = connection.call("status")
        rows = connection.call("gains_list")["gains"]
        running = [[row["name"], row["version"]] for row in rows if row["active"]]
        _tell(boot=now["axis"]["state"], running=running, note=now["controller"]["note"], **found)
        if not (_TOLD.parent / "last").exists():
            for work in itertools.cycle((_record, _change_gains, _fault)):
                work(connection)
    return {"cuts": [row for row in map(json.loads, _TOLD.read_text().splitlines()) if "boot" in row]}


def _tell(**facts: Any) -> None:
    """On the host's disk before this returns: the guest's own memory is gone with it."""
    with _TOLD.open("a") as file:
        file.write(json.dumps(facts) + "\n")
        file.flush()
        os.fsync(file.fileno())


# --- Work -------------------------------------------------------------------------------------------------------------


def _record(connection: ControlClient) -> None:
    """A motion into a recording that is told, with the last cycle that there has been, until it ends."""
    path = connection.call("record_start")["path"]
    told = {"recording": path, "begun_ns": _now_ns(connection)}
    connection.call("enable")
    connection.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=4.0)
    for _ in range(8):
        now_ns = _now_ns(connection)
        _tell(**told, time_ns=now_ns)
        time.sleep(0.3)
    connection.call("record_stop")
    _tell(**told, time_ns=now_ns, closed=True)
    connection.call("disable")


def _now_ns(connection: ControlClient) -> int:
    """Of the last cycle that there has been."""
    serial = connection.call("cycles")["last"]
    raw = base64.b64decode(connection.call("cycles", after=serial - 1)["records"])
    return CycleRecord(*RECORD.unpack(raw[-RECORD.size :])).time_ns


def _change_gains(connection: ControlClient) -> None:
    """Store a set and make it the active one."""
    gains = yaml.safe_load(GAINS_FILE.read_text())
    gains["parameters"]["position_gain_nm_per_rad"] = 0.5 + (time.time_ns() % 1000) / 1000.0
    stored = connection.call("gains_load", name="power", text=yaml.safe_dump(gains))
    _tell(begun=[stored["name"], stored["version"]])
    connection.call("gains_activate", name=stored["name"], version=stored["version"])
    _tell(active=[stored["name"], stored["version"]])


def _fault(connection: ControlClient) -> None:
    """The drive reports an emergency; its fault file is told when the daemon tells it."""
    before = {incident["file"] for incident in connection.call("faults")["faults"]}
    connection.call("enable")
    subprocess.run(["cansend", INTERFACE, _EMERGENCY], check=True)
    wait_for(lambda: _new_file(connection, before), 60, "the fault file")
    _tell(fault_file=_new_file(connection, before))
    connection.call("enable", reset_fault=True)
    connection.call("disable")


def _new_file(connection: ControlClient, before: set[str]) -> str:
    files = (incident["file"] for incident in connection.call("faults")["faults"])
    return next((file for file in files if file and file not in before), "")


# --- What a cut left --------------------------------------------------------------------------------------------------


def _files(told: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Recordings and fault files that were told since the last start: rows that are missing, and damage."""
    last = {row[kind]: row for row in told for kind in ("recording", "fault_file") if kind in row}
    for path, row in last.items():
        kept_ns, found = row.get("begun_ns", 0), {"path": path, "whole": False, "closed": _is_closed(row)}
        try:
            recording = read_recording(path)
        except BadInput as error:  # as it should be, where the cut came within its first second
            found |= {"unreadable": str(error)}
        else:
            kept_ns = recording.column("time_ns")[-1]
            found |= {"rows": len(recording), "whole": not recording.truncated}
        yield found | {"lost_s": max(0.0, (row["time_ns"] - kept_ns) / 1e9) if "time_ns" in row else 0.0}


def _is_closed(row: dict[str, Any]) -> bool:
    return "fault_file" in row or bool(row.get("closed"))


def _store(config: AxisConfig, said: list[dict[str, Any]]) -> dict[str, Any]:
    """The active set, and which it may be: the last that was told to be active, the first start's where none was, or
    one that was begun after it."""
    done = max((at for at, row in enumerate(said) if "active" in row), default=-1)
    before = said[done]["active"] if done >= 0 else said[0]["running"][0]
    may = [before, *(row["begun"] for row in said[done + 1 :] if "begun" in row)]
    active = GainStore(config.gains.directory, mends=False).active()
    return {"active": [active.name, active.version] if active else None, "may": may}
