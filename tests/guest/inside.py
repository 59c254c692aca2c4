"""Runs inside the guest as root: servod installed, on vcan, under systemd; one JSON line for each thing that was tried.

    python3 inside.py SHARE      SHARE is the host's folder, with site/, systemd/ and gains/

Imports nothing but the standard library before servod stands in place; no timing is judged here.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

SITE = Path("/usr/local/lib/python3.11/dist-packages")
UNIT, SOCKET = "servod@guest.service", "/run/servod/guest.sock"
DRIVE_RECORD = "/run/servod/drive.bin"
PROGRAMS = {
    "servod": "servod.daemon.main",
    "servoctl": "servod.cli",
    "servod-virtual-axis": "servod.drivers.virtual.main",
}

#: Slow on purpose: the guest's one CPU is many times slower than any machine that servod is for.
CONFIG = """
name: guest
bus: {interface: socketcan, channel: vcan0}
cycle: {period_us: 20000, feedback_timeout_us: 15000}
heartbeat: {master_period_ms: 200, drive_timeout_ms: 4000, node_period_ms: 200, node_timeout_ms: 4000}
amplifier: {enable_timeout_s: 20}
limits: {torque_nm: 0.9, torque_rate_nm_per_s: 400.0, speed_rad_s: 20.0, position_min_rad: -3, position_max_rad: 3,
  following_error_rad: 3.0, encoder_mismatch_rad: 0.5, stale_cycles: 500, late_cycles: 5000}
gains: {directory: /var/lib/servod/guest/gains, initial: ../demo_pd.yaml, accept_uncertified: true}
control: {socket: /run/servod/guest.sock, group: servod}
recorder: {directory: /var/lib/servod/guest/recordings, history_s: 5}
metrics: {textfile: /var/lib/servod/metrics/guest.prom}
"""
VIRTUAL_AXIS_DROP_IN = """
[Service]
ExecStart=
ExecStart=/usr/bin/env servod-virtual-axis --can vcan0 --plant /etc/servod/axes/demo_joint.yaml --record {record}
"""
#: Runs in the daemon's own sandbox, before it.
FAMILIES_DROP_IN = """
[Service]
ExecStartPre=/usr/bin/python3 /usr/local/lib/servod-families.py /run/servod/families.json
WatchdogSec=8
"""
FAMILIES_PROBE = """
import json, socket, sys
answers = {}
KINDS = {"AF_CAN": (socket.SOCK_RAW, socket.CAN_RAW), "AF_UNIX": (socket.SOCK_STREAM, 0)}
for name in ("AF_CAN", "AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK", "AF_PACKET"):
    try:
        socket.socket(getattr(socket, name), *KINDS.get(name, (socket.SOCK_RAW, 0))).close()
        answers[name] = "allowed"
    except OSError as error:
        answers[name] = error.strerror
json.dump(answers, open(sys.argv[1], "w"))
"""


def shell(*command: str, check: bool = True, user: str | None = None) -> str:
    """Run a command; its output, both streams together."""
    line = ["runuser", "-u", user, "--", *command] if user else list(command)
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=120)
    if check and done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}: {done.stdout[-2000:]}")
    return done.stdout


def prop(name: str, unit: str = UNIT) -> str:
    """One property of a unit."""
    return shell("systemctl", "show", "-p", name, "--value", unit).strip()


def journal(unit: str = UNIT) -> str:
    """What a unit said in this boot."""
    return shell("journalctl", "-u", unit, "--no-pager", "-o", "cat")


def wait_for(reached: Callable[[], Any], timeout_s: float = 60.0) -> Any:
    """Wait until `reached()` is true, and give it."""
    deadline = time.monotonic() + timeout_s
    while not (value := reached()):
        if time.monotonic() > deadline:
            raise RuntimeError("it did not come in time")
        time.sleep(0.2)
    return value


def client() -> Any:
    """A connection to the daemon."""
    from servod.control import ControlClient

    return ControlClient(SOCKET, timeout_s=60.0)


def status() -> dict[str, Any]:
    """The daemon's status."""
    with client() as connection:
        return dict(connection.call("status"))


def install() -> dict[str, Any]:
    """servod from its wheel, units and users by install.sh, vcan0, and three users."""
    share = Path(sys.argv[1])
    shutil.copytree(share / "site", SITE, dirs_exist_ok=True)
    for name, module in PROGRAMS.items():
        program = Path("/usr/local/bin") / name
        program.write_text(f"#!/usr/bin/python3\nimport sys\nfrom {module} import main\nsys.exit(main())\n")
        program.chmod(0o755)
    shutil.copytree(share / "systemd", "/opt/servod-source/systemd")
    shutil.copytree(share / "gains", "/opt/servod-source/gains")
    shell("/opt/servod-source/systemd/install.sh")
    Path("/etc/servod/config/guest.yaml").write_text(CONFIG)
    Path("/usr/local/lib/servod-families.py").write_text(FAMILIES_PROBE)
    drop_in("servod-virtual-axis.service", VIRTUAL_AXIS_DROP_IN.format(record=DRIVE_RECORD))
    drop_in("servod@.service", FAMILIES_DROP_IN)
    shell("useradd", "--groups", "servod", "fitter")
    shell("useradd", "stranger")
    shell("modprobe", "-a", "can-dev", "can", "can-raw", "vcan")
    shell("ip", "link", "add", "dev", "vcan0", "type", "vcan")
    shell("ip", "link", "set", "vcan0", "up")
    shell("systemctl", "daemon-reload")
    return {
        "verify": shell("systemd-analyze", "verify", *map(str, Path("/etc/systemd/system").glob("servod[@-]*.service")))
    }


def drop_in(unit: str, text: str) -> None:
    """Add to a unit."""
    folder = Path(f"/etc/systemd/system/{unit}.d")
    folder.mkdir(exist_ok=True)
    (folder / "guest.conf").write_text(text)


def start() -> dict[str, Any]:
    """systemctl start returns only when the daemon said READY=1."""
    shell("systemctl", "start", "servod-virtual-axis.service")
    wait_for(lambda: "ready vcan0" in journal("servod-virtual-axis.service"), 240)
    shell("systemctl", "start", UNIT)
    now = status()
    return {
        "active": prop("ActiveState"),
        "status_text": prop("StatusText"),
        "user": shell("stat", "-c", "%U %G %a", SOCKET).strip(),
        "grants": {g["name"]: g["granted"] for g in now["grants"]},
        "axis": now["axis"]["state"],
        "nodes": sorted(n["state"] for n in now["nodes"]),
    }


def families() -> dict[str, Any]:
    """What sockets the daemon's sandbox lets through."""
    return dict(json.loads(Path("/run/servod/families.json").read_text()))


def motion() -> dict[str, Any]:
    """Enable, move, record, disable, by the command line as a member of the group."""
    said = [shell("servoctl", "enable", "--socket", SOCKET, user="fitter")]
    with client() as connection:
        path = connection.call("record_start")["path"]
        connection.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=6.0)
        wait_for(lambda: not connection.call("status")["axis"]["motion_running"])
        connection.call("record_stop")
    said.append(shell("servoctl", "disable", "--socket", SOCKET, user="fitter"))
    from servod.recorder_read import read_recording

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


def recover(hit: Callable[[], None]) -> dict[str, Any]:
    """Do something to the enabled axis, and see systemd bring the daemon back, disabled."""
    with client() as connection:
        connection.call("enable")
    before, pid = int(prop("NRestarts")), prop("MainPID")
    hit()
    wait_for(lambda: int(prop("NRestarts")) > before and prop("MainPID") not in ("0", pid), 120)
    wait_for(lambda: prop("ActiveState") == "active", 120)
    return {"result": prop("Result"), "restarts": int(prop("NRestarts")) - before, "axis": status()["axis"]["state"]}


def watchdog() -> dict[str, Any]:
    """A supervisor that hangs is killed by the watchdog."""
    result = recover(lambda: os.kill(int(prop("MainPID")), signal.SIGSTOP))
    return {**result, "journal": "watchdog" in journal().lower()}


def supervisor_killed() -> dict[str, Any]:
    """kill -9 of the supervisor while the axis moves: the loop brakes, ramps down and switches off by itself."""
    killed_ns = 0

    def hit() -> None:
        nonlocal killed_ns
        with client() as connection:
            connection.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=60.0)
            time.sleep(2)
            killed_ns = time.monotonic_ns()
            os.kill(int(prop("MainPID")), signal.SIGKILL)

    return {**recover(hit), **how_it_stopped(killed_ns)}


def how_it_stopped(since_ns: int) -> dict[str, Any]:
    """The drive's own record: its states since then, and its torque before and when operation ended."""
    from servod.drivers.virtual.drive_record import read_drive_record

    samples = read_drive_record(DRIVE_RECORD)
    after = [s for s in samples if s.time_ns >= since_ns]
    enabled = [s for s in after if s.state.name == "OPERATION_ENABLED"]
    return {
        "drive_states": list(dict.fromkeys(s.state.name for s in after)),
        "torque_before_nm": max(abs(s.torque_demand_nm) for s in samples if s.time_ns < since_ns),
        "torque_at_end_nm": abs(enabled[-1].torque_demand_nm),
    }


def loop_killed() -> dict[str, Any]:
    """kill -9 of the loop: LOOP_LOST in the journal, and the seconds before it in a file."""
    result = recover(lambda: os.kill(int(status()["loop"]["pid"]), signal.SIGKILL))
    files = list(Path("/var/lib/servod/guest/recordings").glob("*LOOP_LOST*.mcap"))
    return {**result, "told": "LOOP_LOST" in journal(), "files": len(files)}


def bad_configuration() -> dict[str, Any]:
    """A mistake in the file ends the start with exit code 2, and systemd does not try again."""
    Path("/etc/servod/config/bad.yaml").write_text(CONFIG.replace("amplifier", "amplyfier"))
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
    with client() as connection:
        connection.call("enable")
    shell("systemctl", "stop", UNIT)
    return {
        "result": prop("Result"),
        "active": prop("ActiveState"),
        "socket_left": Path(SOCKET).exists(),
        "metrics": "servod_axis_state" in Path("/var/lib/servod/metrics/guest.prom").read_text(),
        "stopped_in_order": "the axis is disabled" in journal(),
    }


STEPS = (
    install,
    start,
    families,
    motion,
    rights,
    watchdog,
    supervisor_killed,
    loop_killed,
    bad_configuration,
    stop,
)


def main() -> None:
    """Every step, also after one that failed; the results are on the host as soon as they stand."""
    with (Path(sys.argv[1]) / "results.jsonl").open("w") as results:
        for step in STEPS:
            result: dict[str, Any] = {"step": step.__name__}
            try:
                result |= step()
            except Exception:
                result["error"] = traceback.format_exc()[-3000:]
                with contextlib.suppress(Exception):
                    result["journal_tail"] = shell("journalctl", "--no-pager", "-n", "40", "-o", "cat")[-4000:]
            results.write(json.dumps(result) + "\n")
            results.flush()


if __name__ == "__main__":
    main()
