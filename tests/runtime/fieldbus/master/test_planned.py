"""The bus load that a configuration makes is refused without a bus, by the daemon's check and the command line's."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rig import Rig
from witness import axis_config

from servod.cli.app import run
from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.config import load_config
from servod.runtime.daemon.main import check
from servod.runtime.fieldbus.master.planned import planned_bus_load

CONFIG = shipped("gains") / "config" / "virtual.yaml"


def configured(folder: Path, bit_rate: int) -> Path:
    """The shipped configuration at another bit rate."""
    sections: dict[str, Any] = load_config(CONFIG).model_dump(mode="json")
    sections["bus"]["bit_rate"] = bit_rate
    file = folder / "axis.yaml"
    file.write_text(json.dumps(sections))
    return file


def test_the_plan_alone_gives_the_load_of_the_bring_up() -> None:
    rig = Rig()
    rig.start()
    assert planned_bus_load(rig.config, "axis.yaml").share == rig.up.bus_load


def test_a_driver_of_the_other_kind_is_refused() -> None:
    with pytest.raises(BadInput, match=r"axis.yaml: amplifier.driver.*allowed: cia402$"):
        planned_bus_load(axis_config(amplifier={"driver": "cia406"}), "axis.yaml")


def test_the_daemons_check_refuses_too_slow_a_bus(tmp_path: Path) -> None:
    check(configured(tmp_path, 1_000_000))
    with pytest.raises(BadInput, match=r"axis.yaml: bus load: .*80\.\d % of 500000 bit/s.*at most bus.max_load = 70 %"):
        check(configured(tmp_path, 500_000))


def test_config_check_shows_the_load_and_refuses_too_slow_a_bus(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["config", "check", str(configured(tmp_path, 1_000_000))]) == 0
    assert "bus load 40.0 % at 1000000 bit/s" in capsys.readouterr().out
    assert run(["config", "check", str(configured(tmp_path, 500_000))]) == 2
    assert "% of 500000 bit/s" in capsys.readouterr().err


@pytest.mark.parametrize("below", ["", "deeper/still"])
@pytest.mark.parametrize("section", ["gains", "recorder"])
def test_a_file_in_place_of_a_folder_is_refused_before_the_axis_begins(
    tmp_path: Path, section: str, below: str
) -> None:
    file = tmp_path / "file"
    file.touch()
    sections = load_config(CONFIG).model_dump(mode="json")
    sections[section]["directory"] = str(file / below)
    configuration = tmp_path / "axis.yaml"
    configuration.write_text(json.dumps(sections))
    with pytest.raises(BadInput, match=rf"axis.yaml: {section}.directory: found {file}, which is a file"):
        check(configuration)


@pytest.mark.parametrize("key", ["gains.initial", "model"])
def test_a_missing_file_is_told_with_the_key_that_names_it(key: str, tmp_path: Path) -> None:
    file = configured(tmp_path, 1_000_000)
    sections = json.loads(file.read_text())
    section, _, name = key.rpartition(".")
    (sections[section] if section else sections)[name] = "none.yaml"
    file.write_text(json.dumps(sections))
    with pytest.raises(BadInput) as caught:
        check(file)
    assert str(caught.value) == f"{file}: {key}: {tmp_path / 'none.yaml'}: there is no such file"
