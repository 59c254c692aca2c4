"""The shipped gain sets are what their script makes; a changed demo joint or constant shows here. One is certified."""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.formats.gains.gain_set import load_gains, require_fit
from servod.qualify.demo.axis import CERTIFIED, demo_config, gains_file
from servod.qualify.demo.entries import margins
from servod.runtime.daemon.gain_bank import GainBank

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = "make_gain_sets.py"


def test_the_script_would_write_what_ships() -> None:
    command = [sys.executable, f"scripts/{SCRIPT}", "--check"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


@pytest.mark.parametrize("what", ["joint", "model", "certificate"])
def test_a_certified_set_of_another_joint_or_model_is_stale(tmp_path: Path, what: str) -> None:
    shutil.copytree(ROOT / "gains", tmp_path / "gains")
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts", ignore=lambda _folder, names: set(names) - {SCRIPT})
    file, old, new = {
        "joint": ("axes/demo_joint.yaml", "coulomb: 0.045", "coulomb: 0.046"),
        "model": ("axes/demo_joint_identified.yaml", "kind: local", "kind: local "),
        "certificate": ("demo_local_certified.yaml", "valid: true", "valid: false"),
    }[what]
    stale = tmp_path / "gains" / file
    stale.write_text(stale.read_text().replace(old, new))
    command = [sys.executable, f"scripts/{SCRIPT}", "--check"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert result.returncode == 1 and "demo_local_certified.yaml: " in result.stdout


def test_the_demos_daemon_takes_the_certified_set_by_its_certificate(tmp_path: Path) -> None:
    """With the demo's configuration, but for the key that lets sets without a certificate in."""
    config = demo_config(tmp_path, tmp_path)
    strict = config.model_copy(update={"gains": config.gains.model_copy(update={"accept_uncertified": False})})
    require_fit(load_gains(gains_file(CERTIFIED)), strict)
    with pytest.raises(BadInput, match="certificate"):
        require_fit(load_gains(gains_file("local")), strict)
    started = strict.gains.model_copy(update={"initial": gains_file(CERTIFIED)})
    assert GainBank(strict.model_copy(update={"gains": started})).newest.gains.certificate_problem() is None


def test_the_certified_set_is_certified_by_the_checks_that_ship_with_it() -> None:
    """Else the first line of the demo warns of it: `servoctl verify gains/demo_local_certified.yaml` issues one."""
    assert load_gains(gains_file(CERTIFIED)).certificate_warning() is None


def test_the_margins_that_the_demo_tells_are_those_of_the_certificate() -> None:
    gains = load_gains(gains_file(CERTIFIED))
    certificate = gains.certificate
    assert certificate is not None
    told = margins(gains)
    assert told is not None and told.plants >= 1000
    disk = next(check.value for check in certificate.checks if check.name == "symmetric disk margin")
    factor = 10.0 ** (told.gain_margin_db / 20.0)
    assert 2.0 * (factor - 1.0) / (factor + 1.0) == pytest.approx(disk)
    assert 2.0 * math.tan(math.radians(told.phase_margin_deg) / 2.0) == pytest.approx(disk)
    assert told.delay_ms < told.tolerated_delay_ms < 5.0
    assert told.tolerated_inertia[0] < 1.0 < told.tolerated_inertia[1] and told.tolerated_friction > 1.0
    assert "dB" in str(told) and "1000 of 1000 plants" in str(told)


def test_a_set_whose_certificate_does_not_count_has_no_margins() -> None:
    gains = load_gains(gains_file(CERTIFIED))
    assert margins(load_gains(gains_file("local"))) is None
    assert margins(gains.model_copy(update={"description": "changed after it was sealed"})) is None
