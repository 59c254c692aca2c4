"""`servoctl config check` on everything that ships, and its JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import servod.drivers
from servod.cli.app import run
from servod.shipped import shipped

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


def test_several_files_are_checked_in_order_and_the_first_mistake_ends_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.yaml"
    bad.write_text("inertia: -1\n")
    assert run(["config", "check", str(SHIPPED[0]), str(bad)]) == 2
    assert "bad.yaml: inertia" in capsys.readouterr().err
