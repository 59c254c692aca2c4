import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from servod.formats.config import LimitsConfig, load_config
from servod.runtime.loop.cycle import GOODBYE_TIMEOUT_S

SYSTEMD = Path(__file__).parents[3] / "systemd"
#: Without that which is no program of servod's, but ip(8) once at the start, as root in the machine's own name spaces.
UNITS = sorted(set(SYSTEMD.glob("*.service")) - {SYSTEMD / "servod-bus@.service"})


def test_verify_prints_nothing() -> None:
    done = subprocess.run(["systemd-analyze", "verify", *map(str, UNITS)], capture_output=True, text=True)
    assert (done.stdout + done.stderr, done.returncode) == ("", 0)


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_exposure_is_at_most_3(unit: Path) -> None:
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True)
    found = re.search(r"Overall exposure level for \S+: ([0-9.]+)", done.stdout)
    assert found is not None, done.stderr
    assert float(found[1]) <= 3.0


def test_address_families_are_can_and_unix_only() -> None:
    for unit in UNITS:
        assert re.findall(r"^RestrictAddressFamilies=(.*)$", unit.read_text(), re.M) == ["AF_CAN AF_UNIX"]


def test_no_signal_kills_the_loop_before_it_has_stopped_the_axis() -> None:
    unit = (SYSTEMD / "servod@.service").read_text()
    assert _key(unit, "KillMode") == "control-group"  # SIGTERM to the loop also when the supervisor is gone
    assert _key(unit, "WatchdogSignal") == "SIGTERM"  # it too goes to the whole group
    (longest,) = [m.le for m in LimitsConfig.model_fields["ramp_down_s"].metadata if hasattr(m, "le")]
    assert float(_key(unit, "TimeoutStopSec")) > 2.0 * longest + GOODBYE_TIMEOUT_S


def test_the_service_waits_for_late_nodes_and_fills_no_journal() -> None:
    unit = (SYSTEMD / "servod@.service").read_text()
    assert "servod --wait " in _key(unit, "ExecStart")
    assert int(_key(unit, "LogRateLimitBurst")) / int(_key(unit, "LogRateLimitIntervalSec").removesuffix("s")) <= 20


def test_drop_in_binds_the_service_to_its_interface(tmp_path: Path) -> None:
    shutil.copytree(SYSTEMD / "servod@can0.service.d", tmp_path / "servod@can0.service.d")
    (tmp_path / "servod@can0.service").write_text((SYSTEMD / "servod@.service").read_text())
    done = subprocess.run(
        ["systemd-analyze", "verify", str(tmp_path / "servod@can0.service")], capture_output=True, text=True
    )
    assert (done.stdout + done.stderr, done.returncode) == ("", 0)
    text = (tmp_path / "servod@can0.service.d/device.conf").read_text()
    assert {_key(text, "BindsTo"), _key(text, "WantedBy")} == {"sys-subsystem-net-devices-can0.device"}


def _key(unit: str, name: str) -> str:
    (value,) = re.findall(rf"^{name}=(.*)$", unit, re.M)
    return str(value)


def test_install_puts_everything_where_the_units_look(tmp_path: Path) -> None:
    subprocess.run([SYSTEMD / "install.sh"], env={**os.environ, "DESTDIR": str(tmp_path)}, check=True)
    assert {u.name for u in UNITS} <= {p.name for p in (tmp_path / "etc/systemd/system").iterdir()}
    config = load_config(tmp_path / "etc/servod/config/virtual.yaml")
    assert config.gains.initial.exists()
    command = re.search(r"--plant (\S+)", (SYSTEMD / "servod-virtual-axis.service").read_text())
    assert command is not None
    assert (tmp_path / command[1].lstrip("/")).exists()
    mine = tmp_path / "etc/servod/config/can0.yaml"
    mine.write_text("mine")
    subprocess.run([SYSTEMD / "install.sh"], env={**os.environ, "DESTDIR": str(tmp_path)}, check=True)
    assert mine.read_text() == "mine"
