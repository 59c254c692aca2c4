"""Other people's devices on vcan1, an axis of their own: CANopenNode as encoder and amplifier (tests/foreign/c).

In a time that is SCALE times slower, since one slow CPU carries both sides: every period and time-out is as many times
longer as the cycle is, and what counts cycles is as by default. So each is shown in its proportion to all others.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import struct
import sys
import time
from pathlib import Path
from typing import Any

import yaml

from inside.tools import CONFIG, journal, prop, shell, wait_for
from servod.client.control import ControlClient
from servod.common.errors import ServodError
from servod.formats.config import CycleConfig, HeartbeatConfig

UNIT, SOCKET, INTERFACE = "servod@foreign.service", "/run/servod/foreign.sock", "vcan1"
NODES = {"amplifier": 1, "encoder": 2}
JOINT = Path("/run/servod/joint")
#: A cycle of 20 ms is the longest that there is.
SCALE = 20
#: How long the axis moves, in scaled time [s].
_MOTION_S = 1.0


def foreign() -> dict[str, Any]:
    """Brought up, enabled, moved; the whole master killed, brought up again by systemd and enabled by hand."""
    shell("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
    shell("ip", "link", "set", INTERFACE, "up")
    for name, node_id in NODES.items():
        program = shutil.copy(Path(sys.argv[1]) / "canopennode" / name, f"/usr/local/bin/foreign-{name}")
        started = ["--setenv", f"JOINT={JOINT}", str(program), INTERFACE, "-i", str(node_id)]
        # Before whatever starts beside it on the one CPU, as the virtual axis: five cycles without an answer are stale.
        shell("systemd-run", "--collect", "--nice=-10", "--unit", f"foreign-{name}", *started)
    Path("/etc/servod/config/foreign.yaml").write_text(yaml.safe_dump(_scaled()))
    shell("systemctl", "start", UNIT)
    try:
        return _tried()
    finally:
        for unit in (UNIT, *(f"foreign-{name}" for name in NODES)):
            shell("systemctl", "stop", unit, check=False)
        shell("ip", "link", "delete", INTERFACE)


def _scaled() -> dict[str, Any]:
    """The guest's configuration with the default times, SCALE times longer."""
    text = CONFIG.replace("guest/", "foreign/").replace("guest.", "foreign.").replace("name: guest", "name: foreign")
    config: dict[str, Any] = yaml.safe_load(text.replace("vcan0", INTERFACE))
    config["amplifier"]["quirks"] = "canopennode"
    cycle, heartbeat = CycleConfig(), HeartbeatConfig()
    config["cycle"] = {key: SCALE * getattr(cycle, key) for key in ("period_us", "feedback_timeout_us")}
    times = ("master_period_ms", "drive_timeout_ms", "node_period_ms", "node_timeout_ms")
    config["heartbeat"] = {key: SCALE * getattr(heartbeat, key) for key in times}
    for key in ("stale_cycles", "late_cycles"):
        del config["limits"][key]
    return config


def _tried() -> dict[str, Any]:
    wait_for(_has_begun, 60, "the loop")
    supervisor = int(prop("MainPID", UNIT))
    with _client() as client:
        nodes = sorted(node["state"] for node in client.call("status")["nodes"])
        moved_rad = _moved(client)
        time.sleep(SCALE * _MOTION_S)
        now = client.call("status")
    pids = [int(now["loop"]["pid"]), supervisor]
    powered, stopped_ms = _joint()[3], _killed(pids)
    torque_nm = _joint()[2]
    wait_for(lambda: prop("MainPID", UNIT) not in ("0", str(pids[1])), 60, "the restart")
    wait_for(lambda: prop("ActiveState", UNIT) == "active", 120, "readiness")
    wait_for(_has_begun, 60, "the loop")
    with _client() as client:
        axis = client.call("status")["axis"]["state"]
        again_rad = _moved(client)
        client.call("disable")
    return {
        "nodes": nodes,
        "moved_rad": moved_rad,
        "moving": now["axis"]["state"],
        "faults": [fault["code"] for fault in now["faults"]],
        "powered": powered,
        "stopped_ms": stopped_ms,
        "torque_nm": torque_nm,
        "emergency": "errorCode=0x8130" in journal("foreign-amplifier"),
        "axis": axis,
        "again_rad": again_rad,
        "powered_at_end": _joint()[3],
    }


def _killed(pids: list[int]) -> float:
    """Kill the whole master; how long the amplifier's torque stays on, in scaled time."""
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    killed = time.monotonic()
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    while _joint()[3] and time.monotonic() < killed + SCALE:
        time.sleep(0.01)
    return 1e3 * (time.monotonic() - killed) / SCALE


def _has_begun() -> bool:
    with contextlib.suppress(ServodError), _client() as client:
        return bool(client.call("status"))
    return False


def _client() -> ControlClient:
    return ControlClient(SOCKET, timeout_s=60.0)


def _moved(client: ControlClient) -> float:
    """Enable and begin a motion; how far the joint is from its start, by the amplifier's own program."""
    client.call("enable", reset_fault=True)
    start_rad = _joint()[0]
    client.call("track", kind="sine", amplitude_rad=0.3, frequency_hz=0.5, duration_s=60.0)
    wait_for(lambda: abs(_joint()[0] - start_rad) > 0.1, 60, "the motion")
    return abs(_joint()[0] - start_rad)


def _joint() -> tuple[float, float, float, int]:
    """Position, speed, torque, and whether the amplifier is powered."""
    position_rad, speed_rad_s, torque_nm, powered = struct.unpack("=dddI", JOINT.read_bytes()[:28])
    return position_rad, speed_rad_s, torque_nm, powered
