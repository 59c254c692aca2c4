"""The unit: start, readiness, reload, restart, stop, rights, and every way in which systemd brings the daemon back."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from inside.tools import (
    AXIS_UNIT,
    CONFIG,
    CONFIG_FILE,
    DRIVE_RECORD,
    INTERFACE,
    SOCKET,
    UNIT,
    begun_anew,
    client,
    journal,
    journal_entries,
    prop,
    shell,
    status,
    wait_for,
)

#: What the daemon says at every orderly end: to be looked for in what the unit said since.
_END_IN_ORDER = "stopped; the axis is disabled"
MISTAKE = CONFIG.replace("amplifier", "amplyfier")


def readiness() -> dict[str, Any]:
    """Without interface or axis the start never gets to "active", says why, and burns no restart; with both it does."""
    shell("ip", "link", "delete", INTERFACE)
    shell("systemctl", "start", "--no-block", UNIT)
    no_interface = wait_for(lambda: INTERFACE in (text := prop("StatusText")) and text, 60, "what it waits for")
    shell("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
    shell("ip", "link", "set", INTERFACE, "up")
    seen = set()
    deadline = time.monotonic() + 8.0
    while time.monotonic() < deadline:
        seen.add(prop("ActiveState"))
        time.sleep(0.3)
    status_text, restarts = prop("StatusText"), int(prop("NRestarts"))
    shell("systemctl", "start", AXIS_UNIT)
    wait_for(lambda: "ready vcan0" in journal(AXIS_UNIT), 240, "the virtual axis")
    wait_for(lambda: prop("ActiveState") == "active", 120, "readiness")
    lines = [line for line in journal().splitlines() if line.startswith("waiting for bus and nodes: ")]
    told = {"said": lines, "no_interface": no_interface, "status_text": status_text}
    return {"before": sorted(seen), "restarts": restarts, **told}


def started() -> dict[str, Any]:
    """What a start leaves: user, rights, grants, nodes."""
    now = status()
    return {
        "active": prop("ActiveState"),
        "status_text": prop("StatusText"),
        "user": shell("stat", "-c", "%U %G %a", SOCKET).strip(),
        "daemon_user": shell("ps", "-o", "user=", "-p", prop("MainPID")).strip(),
        "grants": {g["name"]: g["granted"] for g in now["grants"]},
        "axis": now["axis"]["state"],
        "nodes": sorted(n["state"] for n in now["nodes"]),
    }


def sandbox() -> dict[str, Any]:
    """What the daemon's sandbox lets through, and what systemd says of it."""
    said = shell("systemd-analyze", "security", "--no-pager", UNIT, check=False)
    exposure = re.search(r"Overall exposure level[^:]*: ([0-9.]+)", said)
    return {**json.loads(Path("/run/servod/probe.json").read_text()), "exposure": exposure and float(exposure[1])}


def motion() -> dict[str, Any]:
    """Enable, move, record, disable, by the command line as a member of the group."""
    said = [shell("servoctl", "enable", "--socket", SOCKET, user="fitter")]
    with client() as connection:
        path = connection.call("record_start")["path"]
        connection.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=4.0, renew_s=None)
        wait_for(lambda: not connection.call("status")["axis"]["motion_running"])
        connection.call("record_stop")
    said.append(shell("servoctl", "disable", "--socket", SOCKET, user="fitter"))
    from servod.formats.recording.mcap_reader import read_recording

    recording = read_recording(path)
    positions = recording.column("position_rad")
    return {
        "said": said,
        "rows": len(recording),
        "moved_rad": max(positions) - min(positions),
        "after": status()["axis"]["state"],
    }


def rights() -> dict[str, Any]:
    """A user outside the group gets nothing."""
    done = subprocess.run(
        ["runuser", "-u", "stranger", "--", "servoctl", "enable", "--socket", SOCKET], capture_output=True, text=True
    )
    return {"exit_code": done.returncode, "said": done.stderr.strip(), "axis": status()["axis"]["state"]}


def reload() -> dict[str, Any]:
    """A reload checks the file and leaves the axis as it is; a mistake fails it with its line."""
    with client() as connection:
        connection.call("enable")
        pid = prop("MainPID")
        good = subprocess.run(["systemctl", "reload", UNIT]).returncode
        CONFIG_FILE.write_text(MISTAKE)
        bad = subprocess.run(["systemctl", "reload", UNIT], stderr=subprocess.DEVNULL).returncode
        CONFIG_FILE.write_text(CONFIG)
        same = prop("MainPID") == pid and prop("ActiveState") == "active"
        axis = connection.call("status")["axis"]["state"]
        connection.call("disable")
    return {"good": good, "bad": bad, "same_process": same, "axis": axis, "told": "did you mean amplifier" in journal()}


def restart() -> dict[str, Any]:
    """A restart while the axis is enabled ends it in order, and comes back disabled."""
    with client() as connection:
        connection.call("enable")
    pid, before = prop("MainPID"), len(journal())
    shell("systemctl", "restart", UNIT)
    said = _END_IN_ORDER in journal()[before:]
    return {"other_process": prop("MainPID") != pid, "axis": status()["axis"]["state"], "in_order": said}


def recover(hit: Callable[[], None]) -> dict[str, Any]:
    """Do something to the enabled axis, and see systemd bring the daemon back, disabled."""
    with client() as connection:
        connection.call("enable")
    before, pid = int(prop("NRestarts")), prop("MainPID")
    hit()
    wait_for(lambda: int(prop("NRestarts")) > before and prop("MainPID") not in ("0", pid), 120, "the restart")
    wait_for(lambda: prop("ActiveState") == "active", 120, "readiness")
    return {"result": prop("Result"), "restarts": int(prop("NRestarts")) - before, "axis": status()["axis"]["state"]}


def watchdog() -> dict[str, Any]:
    """A supervisor that hangs is killed by the watchdog."""
    result = recover(lambda: os.kill(int(prop("MainPID")), signal.SIGSTOP))
    return {**result, "journal": "watchdog" in journal().lower()}


def loop_stopped() -> dict[str, Any]:
    """A loop that stands still is ended by the supervisor, which feeds the watchdog no more; systemd starts both."""
    result = recover(lambda: os.kill(int(status()["loop"]["pid"]), signal.SIGSTOP))
    return {**result, "told": "LOOP_LOST" in journal()}


def supervisor_killed() -> dict[str, Any]:
    """kill -9 of the supervisor while the axis moves: the loop brakes and switches off by itself."""
    killed_ns = 0

    def hit() -> None:
        nonlocal killed_ns
        with client() as connection:
            connection.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=60.0, renew_s=None)
            time.sleep(2)
            killed_ns = time.monotonic_ns()
            os.kill(int(prop("MainPID")), signal.SIGKILL)

    return {**recover(hit), **how_it_stopped(killed_ns)}


def how_it_stopped(since_ns: int) -> dict[str, Any]:
    """The drive's own record: its states since then, its torque before, torque and speed when operation ended."""
    from servod.drivers.virtual.drive_record import read_drive_record

    samples = read_drive_record(DRIVE_RECORD)
    after = [s for s in samples if s.time_ns >= since_ns]
    enabled = [s for s in after if s.state.name == "OPERATION_ENABLED"]
    return {
        "drive_states": list(dict.fromkeys(s.state.name for s in after)),
        "torque_before_nm": max(abs(s.torque_demand_nm) for s in samples if s.time_ns < since_ns),
        "torque_at_end_nm": abs(enabled[-1].torque_demand_nm),
        "speed_at_end_rad_s": abs(enabled[-1].velocity_rad_s),
    }


def loop_killed() -> dict[str, Any]:
    """kill -9 of the loop: fault, cause and remedy in the journal at level error, the seconds before it in a file."""
    from servod.common.faults import FAULTS, FaultCode

    result = recover(lambda: os.kill(int(status()["loop"]["pid"]), signal.SIGKILL))
    files = list(Path("/var/lib/servod/guest/recordings").glob("*LOOP_LOST*.mcap"))
    told = [entry for entry in journal_entries() if "fault LOOP_LOST (DISABLE)" in str(entry.get("MESSAGE"))]
    remedy = FAULTS[FaultCode.LOOP_LOST].remedy
    return {
        **result,
        "files": len(files),
        "levels": sorted({entry["PRIORITY"] for entry in told}),
        "remedy": bool(told) and all(remedy in entry["MESSAGE"] for entry in told),
    }


def bad_configuration() -> dict[str, Any]:
    """A mistake in the file ends the start with exit code 2, and systemd does not try again."""
    Path("/etc/servod/config/bad.yaml").write_text(MISTAKE)
    unit = "servod@bad.service"
    shell("systemctl", "start", unit, check=False)
    time.sleep(4)
    log = journal(unit)
    return {
        "state": prop("ActiveState", unit),
        "exit_code": int(prop("ExecMainStatus", unit)),
        "restarts": int(prop("NRestarts", unit)),
        "line": next((line for line in log.splitlines() if re.search("amplyfier", line)), ""),
    }


def stop() -> dict[str, Any]:
    """An orderly end leaves no socket and no process."""
    begun_anew()  # whatever a start beside it did to a loop that shares one processor with it
    with client() as connection:
        connection.call("enable")
    before = len(journal())
    shell("systemctl", "stop", UNIT)
    return {
        "result": prop("Result"),
        "active": prop("ActiveState"),
        "socket_left": Path(SOCKET).exists(),
        "metrics": "servod_axis_state" in Path("/var/lib/servod/metrics/guest.prom").read_text(),
        "stopped_in_order": _END_IN_ORDER in journal()[before:],
    }
