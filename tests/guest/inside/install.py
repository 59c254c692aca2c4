"""Puts servod in place as the README tells an administrator: its wheel, install.sh, an interface, users."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import yaml

from inside.tools import AXIS_UNIT, CONFIG, CONFIG_FILE, DRIVE_RECORD, GAINS_FILE, INTERFACE, drop_in, shell

SITE = Path("/usr/local/lib/python3.11/dist-packages")
PROGRAMS = {
    "servod": "servod.runtime.daemon.main",
    "servoctl": "servod.cli",
    "servod-virtual-axis": "servod.drivers.virtual.main",
}
#: Without real-time priority: the guest has one CPU, and the supervisor too needs its share of it. But before whatever
#: starts beside it: no drive answers a cycle late for seconds, and then twice.
VIRTUAL_AXIS_DROP_IN = """
[Service]
Nice=-10
ExecStart=
ExecStart=/usr/bin/env servod-virtual-axis --can {interface} --priority 0 --plant {plant} --record {record}
"""
PLANT = "/etc/servod/axes/demo_joint.yaml"
#: The probe runs in the daemon's own sandbox, before it. The rest is for a machine that is slow, and hit often.
DAEMON_DROP_IN = """
[Unit]
StartLimitIntervalSec=0
[Service]
ExecStartPre=/usr/bin/python3 /usr/local/lib/servod-probe.py /run/servod/probe.json
WatchdogSec=8
"""


def install() -> dict[str, Any]:
    """servod from its wheel, units and users by install.sh, vcan0, and two more users."""
    share = Path(sys.argv[1])
    shutil.copytree(share / "site", SITE, dirs_exist_ok=True)
    modules = ", ".join([*PROGRAMS.values(), "servod.runtime.loop.process"])
    shell("python3", "-c", f"import {modules}")  # leaves them compiled: users of the guest may not write there
    for name, module in PROGRAMS.items():
        program = Path("/usr/local/bin") / name
        program.write_text(f"#!/usr/bin/python3\nimport sys\nfrom {module} import main\nsys.exit(main())\n")
        program.chmod(0o755)
    for name in ("systemd", "gains"):
        shutil.copytree(share / name, f"/opt/servod-source/{name}")
    shell("/opt/servod-source/systemd/install.sh")
    CONFIG_FILE.write_text(CONFIG)
    GAINS_FILE.write_text(_soft_gains(Path("/etc/servod/demo_pd.yaml")))
    shutil.copy(Path(__file__).with_name("probe.py"), "/usr/local/lib/servod-probe.py")
    drop_in(AXIS_UNIT, VIRTUAL_AXIS_DROP_IN.format(record=DRIVE_RECORD, interface=INTERFACE, plant=PLANT))
    drop_in("servod@.service", DAEMON_DROP_IN)
    shell("useradd", "--groups", "servod", "fitter")
    shell("useradd", "stranger")
    shell("modprobe", "-a", "can-dev", "can", "can-raw", "vcan")
    shell("ip", "link", "add", "dev", INTERFACE, "type", "vcan")
    shell("ip", "link", "set", INTERFACE, "up")
    shell("systemctl", "daemon-reload")
    units = map(str, Path("/etc/systemd/system").glob("servod[@-]*.service"))
    os.sync()  # what an administrator wrote is on the disk long before the power goes
    return {"verify": shell("systemd-analyze", "verify", *units)}


def _soft_gains(shipped: Path) -> str:
    """The shipped PD for a period twenty times as long: as shipped, the joint rings at 50 Hz by half its motion."""
    gains = yaml.safe_load(shipped.read_text())
    gains |= {"name": "guest_pd", "description": "PD for a period of 20 ms."}
    gains["parameters"] |= {"position_gain_nm_per_rad": 1.0, "velocity_gain_nms_per_rad": 0.06}
    return yaml.safe_dump(gains)
