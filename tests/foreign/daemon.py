"""servod on a bus that others made: its configuration in a folder, and a daemon that comes and goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import Any

import yaml

from servod.client.control import ControlClient, Refused
from servod.client.processes import child, wait_until
from servod.common.errors import Unreachable
from servod.common.shipped import shipped
from tests.starved import LOGS

_START_S = 30.0


def configured(folder: Path, **sections: Any) -> Path:
    """A configuration of an axis in `folder`, whose bus is `bus` there, with `sections` besides."""
    limits = {"torque_nm": 0.29, "torque_rate_nm_per_s": 400.0, "speed_rad_s": 5.0, "following_error_rad": 0.3}
    limits |= {"position_min_rad": -1.0, "position_max_rad": 1.0, "encoder_mismatch_rad": 0.05}
    patient = {"stale_cycles": 200, "late_cycles": 500}  # behaviour is tested here, on machines that may be busy
    config = {
        "name": "foreign",
        "bus": {"interface": "virtual", "channel": f"{folder}/bus"},
        "cycle": {"feedback_timeout_us": 800},
        "limits": limits | patient,
        "gains": {
            "directory": f"{folder}/gains",
            "initial": str(shipped("gains/demo_pd.yaml")),
            "accept_uncertified": True,
        },
        "control": {"socket": f"{folder}/axis.sock"},
        "recorder": {"directory": f"{folder}/recordings"},
    }
    file = folder / "axis.yaml"
    file.write_text(yaml.safe_dump(config | sections))
    return file


@contextmanager
def virtual_axis(folder: Path, *options: str) -> Iterator[Path]:
    """A virtual axis that runs; its bus, `bus` in `folder`."""
    bus, log = folder / "bus", folder / "virtual.log"
    with child("servod.drivers.virtual.main", ["--socket", str(bus), *options], log) as process:
        wait_until(bus.exists, process, log, _START_S)
        yield bus


@contextmanager
def daemon(config: Path) -> Iterator[tuple[ControlClient, Popen[bytes]]]:
    """A client of a daemon that answers, and the daemon's process."""
    log, control = config.with_name("servod.log"), config.with_name("axis.sock")
    LOGS.append(log)
    with child("servod.runtime.daemon.main", ["--config", str(config)], log) as process:
        wait_until(lambda: _answers(control), process, log, _START_S)
        with ControlClient(control) as client:
            yield client, process


def _answers(control: Path) -> bool:
    try:
        with ControlClient(control) as client:
            client.call("status")
    except (Unreachable, Refused):
        return False
    return True


def wait_for(reached: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Wait until `reached()`."""
    deadline = time.monotonic() + timeout_s
    while not reached():
        assert time.monotonic() < deadline, "it did not come"
        time.sleep(0.005)
