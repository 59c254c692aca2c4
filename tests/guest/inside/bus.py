"""The bus: the conformance suite on vcan0, and can-utils as an independent party beside the running axis."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from inside.tools import AXIS_UNIT, INTERFACE, UNIT, client, journal, prop, shell, status, wait_for

NAMESPACE = f"servod-{INTERFACE}"
#: As docs/how-to/bus-access.md has it; the axis is not called like its interface here, and vcan has no bit rate.
_OWN_BUS = f"""
[Unit]
Requires=servod-bus@{INTERFACE}.service
After=servod-bus@{INTERFACE}.service
[Service]
NetworkNamespacePath=/run/netns/{NAMESPACE}
"""
_SEND = ("cansend", INTERFACE, "601#4000100000000000")


def conformance() -> dict[str, Any]:
    """tests/conformance, as on every other bus; only those of its tests that open one are told apart by it."""
    tests = Path(sys.argv[1]) / "tests" / "conformance"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", INTERFACE, str(tests)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    return {"exit_code": done.returncode, "said": done.stdout.strip()[-1500:]}


def witness() -> dict[str, Any]:
    """candump(1) sees what the two sides say to each other while the axis moves, and its frames are well formed."""
    with client() as connection:
        connection.call("enable")
        connection.call("track", kind="sine", amplitude_rad=0.2, frequency_hz=0.5, duration_s=30.0)
        dumped = shell("candump", "-L", "-n", "400", "-T", "3000", INTERFACE, check=False)
        connection.call("disable")
    frames = re.findall(r"\) \w+ ([0-9A-F]{3})#([0-9A-F]*)", dumped)
    counts = Counter(can_id for can_id, _ in frames)
    lengths = {can_id: sorted({len(data) // 2 for seen, data in frames if seen == can_id}) for can_id in counts}
    return {"counts": dict(counts), "lengths": lengths}


def own_bus() -> dict[str, Any]:
    """The interface in the namespace of the service: a user finds none, whatever he tries; root is a foreign master."""
    before = shell(*_SEND, user="stranger", check=False)
    shell("systemctl", "stop", UNIT, AXIS_UNIT)
    for unit, name, text in (
        (UNIT, "own-bus", _OWN_BUS),
        (AXIS_UNIT, "own-bus", _OWN_BUS),
        (f"servod-bus@{INTERFACE}.service", "guest", "[Service]\nEnvironment=LINK=\n"),
    ):
        folder = Path(f"/etc/systemd/system/{unit}.d")
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.conf").write_text(text)
    shell("systemctl", "daemon-reload")
    shell("systemctl", "start", "--no-block", AXIS_UNIT, UNIT)
    wait_for(lambda: prop("ActiveState") == "active", 240, "the axis in its namespace")
    enter = f"nsenter --net=/run/netns/{NAMESPACE}"
    tried = {
        "plainly": _SEND,
        "by the namespace's name": ("ip", "netns", "exec", NAMESPACE, *_SEND),
        "by the namespace's file": (*enter.split(), *_SEND),
        "as root of a namespace of his own": ("unshare", "-Ur", *enter.split(), *_SEND),
    }
    said = {how: shell(*command, user="stranger", check=False).strip() for how, command in tried.items()}
    with client() as connection:
        connection.call("enable")
        enabled = connection.call("status")["axis"]["state"]
    shell("ip", "netns", "exec", NAMESPACE, *_SEND)
    wait_for(lambda: "FOREIGN_SDO" in {fault["code"] for fault in status()["faults"]}, 30, "the fault")
    told = "SDO request of somebody else" in journal()
    shell("systemctl", "stop", UNIT, AXIS_UNIT, f"servod-bus@{INTERFACE}.service")
    back = shell("ip", "-o", "link", "show", INTERFACE, check=False)
    return {"before": before, "said": said, "enabled": enabled, "told": told, "back": INTERFACE in back}
