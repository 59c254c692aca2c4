"""`servoctl faults`: which scenarios run, what is printed and written, and how it ends."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod.campaign.run import Outcome
from servod.cli.app import run

MINE = """
title: "<script>mine</script>"
why: x
group: own
start: disabled
inject: [{do: {object_write: {who: amplifier, index: 0x2000, subindex: 1, value: 0x2310}}}]
watch_ms: 20
expect: {axis: [AXIS], torque_gone_ms: 5}
recover: repair
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text(MINE.replace("AXIS", "DISABLED"))
    return path


def test_a_scenario_of_ones_own_is_run_told_and_written(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = mine.parent / "out"
    assert run(["faults", "--scenario", str(mine), "--out", str(out)]) == 0
    shown = capsys.readouterr()
    assert "1 of 1 passed mine" in shown.err
    assert "1 of 1 scenarios in 1 files passed." in shown.out
    document = json.loads((out / "faults.json").read_text())
    assert (document["planned"], document["passed"], document["scenarios"][0]["name"]) == (1, 1, "mine")
    page = (out / "report.html").read_text()
    assert "<script>mine" not in page
    assert "&lt;script&gt;mine" in page


def test_one_that_does_not_pass_is_exit_code_1_and_says_why(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine.write_text(MINE.replace("AXIS", "ENABLED"))
    assert run(["faults", "--scenario", str(mine), "--json"]) == 1
    shown = capsys.readouterr()
    assert json.loads(shown.out)["scenarios"][0]["complaints"] == ["the axis ended DISABLED, expected ENABLED"]
    assert shown.err.splitlines()[-1] == "servoctl: 1 of 1 scenarios did not pass: mine"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--only", "no such"], "--only"),
        (["--group", "weather"], "--group: found weather; allowed: bus"),
        (["--scenario", "/nowhere.yaml"], "/nowhere.yaml"),
    ],
)
def test_bad_input_is_one_line(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["faults", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line


def test_interrupted_it_writes_what_it_has(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servod.campaign import campaign

    def interrupted(chosen: dict, jobs: int) -> Iterator[Outcome]:
        for name, scenario in chosen.items():
            yield campaign.outcome_of(name, scenario)
            raise KeyboardInterrupt

    second = mine.with_name("second.yaml")
    second.write_text(mine.read_text())
    monkeypatch.setattr(campaign, "outcomes", interrupted)
    out = mine.parent / "out"
    files = ["--scenario", str(mine), "--scenario", str(second)]
    assert run(["faults", *files, "--out", str(out)]) == 130
    assert json.loads((out / "faults.json").read_text())["run"] == 1
    assert "1 of 2 were not run." in capsys.readouterr().out


def test_what_does_not_get_to_the_start_has_failed(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine.write_text(mine.read_text() + "config: {amplifier: {identity: {serial: 77}}}\n")
    assert run(["faults", "--scenario", str(mine), "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)["scenarios"]
    assert row["axis"] == "not started"
    assert "is another device" in row["complaints"][0]
