"""`servoctl config check` on everything that ships, and its JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import servod.drivers
from servod.cli.app import run
from servod.common.shipped import shipped
from servod.formats.config import load_config
from servod.formats.gains.gain_set import GainSet, parse_gains
from tests.formats.gains import good

GAINS = shipped("gains")
EDS = Path(servod.drivers.__file__).parent / "eds"
SHIPPED = sorted([*GAINS.glob("*.yaml"), *GAINS.glob("axes/*.yaml"), *GAINS.glob("config/*.yaml"), *EDS.glob("*.eds")])


@pytest.mark.parametrize("file", SHIPPED, ids=lambda f: f.name)
def test_what_ships_has_no_mistakes(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["config", "check", str(file), "--json"])
    captured = capsys.readouterr()
    assert code == 0, captured.err
    (row,) = json.loads(captured.out)["files"]
    assert row["kind"] == {"axes": "axis model", "config": "axis configuration", "eds": "EDS"}.get(
        file.parent.name, "gain set"
    )


def test_every_relative_path_is_relative_to_the_file(tmp_path: Path) -> None:
    limits = load_config(GAINS / "config" / "virtual.yaml").limits.model_dump()
    paths = {
        "bus": {"interface": "virtual", "channel": "run/bus"},
        "amplifier": {"eds": "a.eds"},
        "encoder": {"eds": "e.eds"},
        "gains": {"directory": "gains", "initial": "../pd.yaml"},
        "control": {"socket": "run/axis.sock"},
        "recorder": {"directory": "/var/recordings"},
        "metrics": {"textfile": "m.prom"},
    }
    file = tmp_path / "axis.yaml"
    file.write_text(json.dumps({"limits": limits, "model": "model.yaml", **paths}))
    config = load_config(file)
    assert (config.bus.channel, config.amplifier.eds) == (str(tmp_path / "run/bus"), str(tmp_path / "a.eds"))
    assert (config.encoder.eds, config.model) == (str(tmp_path / "e.eds"), tmp_path / "model.yaml")
    assert (config.gains.directory, config.gains.initial) == (tmp_path / "gains", tmp_path / "../pd.yaml")
    assert (config.control.socket, config.metrics.textfile) == (tmp_path / "run/axis.sock", tmp_path / "m.prom")
    assert config.recorder.directory == Path("/var/recordings")


def test_the_channel_of_a_real_bus_is_no_path(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    file.write_text((GAINS / "config" / "can0.yaml").read_text())
    assert load_config(file).bus.channel == "can0"


def test_several_files_are_checked_in_order_and_the_first_mistake_ends_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text("inertia: -1\n")
    assert run(["config", "check", str(SHIPPED[0]), str(bad)]) == 2
    assert "bad.yaml: inertia" in capsys.readouterr().err


def _changed(gains: GainSet, **update: Any) -> GainSet:
    return gains.model_copy(update=update)


CERTIFIED = good.certified(parse_gains(good.PD, "good"))
OTHER = _changed(parse_gains(good.PD, "good").parameters, velocity_gain_nms_per_rad=0.2)
ANOTHER_HASH = _changed(CERTIFIED.certificate, parameters_sha256="0" * 64)


@pytest.mark.parametrize(
    ("gains", "key", "found"),
    [
        (_changed(CERTIFIED, parameters=OTHER), "seal", "numbers that were changed after the set was sealed"),
        (_changed(CERTIFIED, seal="0" * 64), "seal", "numbers that were changed after the set was sealed"),
        (_changed(CERTIFIED, certificate=None), "seal", "or a certificate that was taken out"),
        (_changed(CERTIFIED, seal=None), "seal", "no seal, although the set has a design"),
        (_changed(CERTIFIED, certificate=ANOTHER_HASH).sealed(), "certificate.parameters_sha256", "other parameters"),
    ],
    ids=["a number", "the seal", "no certificate", "no seal", "the hash"],
)
def test_a_set_that_was_tampered_with_is_a_mistake(
    gains: GainSet, key: str, found: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "gains.yaml"
    file.write_text(gains.to_yaml())
    assert run(["config", "check", str(file)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{file}: {key}: found" in line and found in line and "verify`" in line


def test_a_set_without_a_certificate_is_allowed_and_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "gains.yaml"
    file.write_text(good.PD)
    assert run(["config", "check", str(file)]) == 0
    assert "law pd, not certified: no certificate" in capsys.readouterr().out


@pytest.mark.parametrize("key", ["limit", "limits.torqe_nm", "torque_n", "limit.torque_nm"])
def test_a_misspelt_key_is_told_what_was_near(key: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "keys", key]) == 2
    meant = capsys.readouterr().err.partition("did you mean ")[2]
    assert "limits" in meant and (key == "limit" or "limits.torque_nm" in meant)


def test_a_group_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "axis.yaml"
    text = (GAINS / "config" / "can0.yaml").read_text().replace("../demo_pd.yaml", str(GAINS / "demo_pd.yaml"))
    file.write_text(text.replace("group: servod", "group: nobody-has-this"))
    assert run(["config", "check", str(file)]) == 0
    assert "no group nobody-has-this (control.group)" in capsys.readouterr().out
