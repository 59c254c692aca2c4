"""Daemon and virtual axis as separate processes on a virtual bus, in a folder of their own, for tests that kill."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from subprocess import Popen

from servod.control import ControlClient, Verb
from servod.demo.processes import child, wait_until
from servod.drivers.virtual.drive_record import DriveSample, read_drive_record
from servod.shipped import shipped

CONFIG = """
name: doomed
bus: {{interface: virtual, channel: {folder}/bus}}
cycle: {{feedback_timeout_us: 800}}
limits:
  torque_nm: 0.3
  torque_rate_nm_per_s: 300.0
  speed_rad_s: 20.0
  position_min_rad: -3.0
  position_max_rad: 3.0
  following_error_rad: 0.5
  encoder_mismatch_rad: 0.05
  stale_cycles: 30
  late_cycles: 200
gains: {{directory: {folder}/gains, initial: {gains}, accept_uncertified: true}}
control: {{socket: {folder}/axis.sock}}
recorder: {{directory: {folder}/recordings}}
"""


@dataclass
class Machine:
    """Both processes and the ways to look at them."""

    folder: Path
    virtual_axis: Popen[bytes]
    daemon: Popen[bytes]

    def client(self) -> ControlClient:
        """A connection to the daemon."""
        return ControlClient(self.folder / "axis.sock")

    def drive_samples(self) -> list[DriveSample]:
        """The drive's own record, whoever died."""
        return read_drive_record(self.folder / "drive.bin")

    def wait_for(self, client: ControlClient, state: str, timeout_s: float = 10.0) -> dict:
        """Poll the status until the axis is in `state`."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = client.call(Verb.STATUS)
            if status["axis"]["state"] == state:
                return status
            assert time.monotonic() < deadline, f"{status['axis']} instead of {state}: {status}"
            time.sleep(0.02)

    def start_moving(self, client: ControlClient) -> None:
        """Enable and follow a sine, so that there is torque to lose."""
        client.call(Verb.ENABLE)
        self.wait_for(client, "ENABLED")
        client.call(Verb.TRACK, kind="sine", amplitude_rad=0.2, frequency_hz=1.0, duration_s=30.0)
        time.sleep(0.4)


@contextlib.contextmanager
def machine(folder: Path) -> Iterator[Machine]:
    """Start both, wait until the daemon answers, and leave nothing behind."""
    config = folder / "axis.yaml"
    config.write_text(CONFIG.format(folder=folder, gains=shipped("gains/demo_pd.yaml")))
    bus, log = folder / "bus", folder / "daemon.log"
    arguments = ["--socket", str(bus), "--record", str(folder / "drive.bin")]
    with child("servod.drivers.virtual.main", arguments, folder / "axis.log") as virtual_axis:
        wait_until(bus.exists, virtual_axis, folder / "axis.log", 20.0)
        with child("servod.daemon.main", ["--config", str(config)], log) as daemon:
            wait_until((folder / "axis.sock").exists, daemon, log, 20.0)
            yield Machine(folder, virtual_axis, daemon)
