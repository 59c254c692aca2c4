"""`servoctl config check` on everything that ships, and its JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import servod.drivers
from servod.cli.app import run
from servod.common.shipped import shipped
from servod.formats.config import load_config

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


def test_a_group_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "axis.yaml"
    text = (GAINS / "config" / "can0.yaml").read_text().replace("../demo_pd.yaml", str(GAINS / "demo_pd.yaml"))
    file.write_text(text.replace("group: servod", "group: nobody-has-this"))
    assert run(["config", "check", str(file)]) == 0
    assert "no group nobody-has-this (control.group)" in capsys.readouterr().out
