"""Commands, units, journal and control socket of the guest, as an administrator has them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

UNIT, AXIS_UNIT, SOCKET = "servod@guest.service", "servod-virtual-axis.service", "/run/servod/guest.sock"
INTERFACE = "vcan0"
DRIVE_RECORD = "/run/servod/drive.bin"
CONFIG_FILE, GAINS_FILE = Path("/etc/servod/config/guest.yaml"), Path("/etc/servod/guest_pd.yaml")

#: Slow on purpose: the guest's one CPU is many times slower than any machine that servod is for. One period is twenty
#: of those that servod is made for, and heartbeats and ramp go with it: braking within one cycle, a joint is let go of
#: at whatever speed that cycle left it. A joint that was let go of may turn far.
CONFIG = """
name: guest
bus: {interface: socketcan, channel: vcan0}
cycle: {period_us: 20000, feedback_timeout_us: 15000}
heartbeat: {master_period_ms: 200, drive_timeout_ms: 2000, node_period_ms: 200, node_timeout_ms: 3000}
amplifier: {enable_timeout_s: 20}
wiring_proof: {enabled: false}  # at 50 Hz the joint is far away before its first answer comes
limits: {torque_nm: 0.9, torque_rate_nm_per_s: 400.0, speed_rad_s: 20.0, position_min_rad: -999, position_max_rad: 999,
  following_error_rad: 3.0, encoder_mismatch_rad: 0.5, stale_cycles: 100, late_cycles: 5000, ramp_down_s: 0.4}
gains: {directory: /var/lib/servod/guest/gains, initial: /etc/servod/guest_pd.yaml, accept_uncertified: true}
control: {socket: /run/servod/guest.sock, group: servod}
recorder: {directory: /var/lib/servod/guest/recordings, history_s: 5}
metrics: {textfile: /var/lib/servod/metrics/guest.prom}
"""


#: What failed while the host kept the processor from the guest is run again, so often at most.
AGAIN = 2


def unless_starved(run: Callable[[], dict[str, Any]], wrong: str) -> dict[str, Any]:
    """The last run's result, where `wrong` says what was; each that failed wants a saying of the host of its own."""
    for left in reversed(range(AGAIN + 1)):
        before = _starved()
        result = run()
        if not result.get(wrong):
            break
        result["starved"] = sorted(_starved() - before)
        if not left or not result["starved"]:
            break
        print(json.dumps(result), flush=True)
    return result


def _starved() -> set[str]:
    """What tests/guest/host.py wrote down so far."""
    return {file.name for file in (Path(sys.argv[1]) / "starved").glob("*")}


def shell(*command: str, check: bool = True, user: str | None = None, timeout_s: float = 120) -> str:
    """Run a command; its output, both streams together."""
    line = ["runuser", "-u", user, "--", *command] if user else list(command)
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout_s)
    if check and done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}: {done.stdout[-2000:]}")
    return done.stdout


def prop(name: str, unit: str = UNIT) -> str:
    """One property of a unit."""
    return shell("systemctl", "show", "-p", name, "--value", unit).strip()


def journal(unit: str = UNIT, *options: str) -> str:
    """What a unit said in this boot."""
    return shell("journalctl", "-u", unit, "--no-pager", "-o", "cat", *options)


def journal_entries(unit: str = UNIT) -> list[dict[str, Any]]:
    """The same with all fields."""
    lines = shell("journalctl", "-u", unit, "--no-pager", "-o", "json").splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


def wait_for(reached: Callable[[], Any], timeout_s: float = 60.0, what: str = "it") -> Any:
    """Wait until `reached()` is true, and give it."""
    deadline = time.monotonic() + timeout_s
    while not (value := reached()):
        if time.monotonic() > deadline:
            raise RuntimeError(f"{what} did not come in time")
        time.sleep(0.2)
    return value


def client() -> Any:
    """A connection to the daemon."""
    from servod.client.control import ControlClient

    return ControlClient(SOCKET, timeout_s=60.0)


def status() -> dict[str, Any]:
    """The daemon's status."""
    with client() as connection:
        return dict(connection.call("status"))


def at_rest() -> bool:
    """Whether the daemon runs, disabled and without a fault."""
    if prop("ActiveState") != "active":
        return False
    now = status()
    return now["axis"]["state"] == "DISABLED" and not now["faults"]


def begun_anew() -> None:
    """A daemon without a fault and with the axis disabled; one that is so already is left."""
    wait_for(lambda: prop("ActiveState") not in ("activating", "deactivating"), what="a settled service")
    if not at_rest():
        shell("systemctl", "restart", UNIT)


def drop_in(unit: str, text: str) -> None:
    """Add to a unit."""
    folder = Path(f"/etc/systemd/system/{unit}.d")
    folder.mkdir(exist_ok=True)
    (folder / "guest.conf").write_text(text)
