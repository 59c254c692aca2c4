"""`servoctl qualify faults`: which scenarios run, what is printed and written, and how it ends."""

import json
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.qualify.faults.judge import ReactionTimes
from servod.qualify.faults.run import HEADER, Outcome, cells
from servod.qualify.faults.scenario import Loss
from servod.qualify.faults.under_test import Observation

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
    assert run(["qualify", "faults", "--scenario", str(mine), "--out", str(out)]) == 0
    shown = capsys.readouterr()
    assert "1 of 1 passed mine" in shown.err
    assert "1 of 1 scenario in 1 file passed." in shown.out
    document = json.loads((out / "faults.json").read_text())
    assert (document["planned"], document["passed"], document["scenarios"][0]["name"]) == (1, 1, "mine")
    page = (out / "report.html").read_text()
    assert "<script>mine" not in page
    assert "&lt;script&gt;mine" in page


def test_one_that_does_not_pass_is_exit_code_1_and_says_why(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine.write_text(MINE.replace("AXIS", "ENABLED"))
    assert run(["qualify", "faults", "--scenario", str(mine), "--json"]) == 1
    shown = capsys.readouterr()
    assert json.loads(shown.out)["scenarios"][0]["complaints"] == ["the axis ended DISABLED, expected ENABLED"]
    assert shown.err.splitlines()[-1] == "servoctl: 1 of 1 scenario did not pass: mine"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--only", "no such"], "--only"),
        (["--group", "weather"], "--group: found weather; allowed: brake, bus"),
        (["--scenario", "/nowhere.yaml"], "/nowhere.yaml"),
    ],
)
def test_bad_input_is_one_line(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["qualify", "faults", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (MINE.replace("0x2000", "0x3333"), "inject.0.do.object_write: (top): found index: 13107"),
        (MINE.replace("0x2310", "1" + 24 * "0"), "allowed: value 0 to 65535 for 0x2000:1"),
        (MINE.replace("AXIS", "AWAKE"), "expect.axis.0: found 'AWAKE'; allowed: one of BRAKING"),
        (MINE.replace("[AXIS]", "[DISABLED], faults: [SHARK]"), "expect.faults.0: found 'SHARK'"),
        (MINE + "config: {limits: {torque: 1.0}}", "config: limits.torque: found an unknown key"),
        (MINE + "config: {wiring_proof: {ramp_s: 9.0}}", "config: wiring_proof: found ramp_s: 9.0"),
        (MINE + "settings: {gear: 1.0}", "settings: gear: found an unknown key"),
        (MINE + "plant: {inertia: heavy}", "plant: inertia: found 'heavy'"),
    ],
)
def test_a_mistake_in_a_scenario_is_found_when_it_is_read(
    text: str, told: str, mine: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine.write_text(text.replace("[AXIS]", "[DISABLED]"))
    assert run(["qualify", "faults", "--scenario", str(mine)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"servoctl: {mine}: ")
    assert told in line


def test_one_that_breaks_off_has_failed_and_the_next_one_runs(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servod.qualify.faults.stepped import SteppedUnderTest

    sound, broken = mine.with_name("sound.yaml"), []
    sound.write_text(mine.read_text())
    observe = SteppedUnderTest.observe

    def breaks_once(axis: SteppedUnderTest) -> Observation:
        if not broken:
            broken.append(axis)
            raise struct.error("int too large\nto convert")
        return observe(axis)

    monkeypatch.setattr(SteppedUnderTest, "observe", breaks_once)
    assert run(["qualify", "faults", "--scenario", str(mine), "--scenario", str(sound)]) == 1
    shown = capsys.readouterr()
    assert "1 of 2 FAILED mine: error: int too large to convert" in shown.err.splitlines()
    rows = [line.split() for line in shown.out.splitlines() if line.startswith(("mine", "sound"))]
    assert [row[1:4] for row in rows] == [["NO", "broken", "off"], ["yes", "DISABLED", "-"]]
    assert "1 of 2 scenarios" in shown.out


@pytest.mark.parametrize(
    ("recovered", "by_repair", "told"), [(True, False, "yes"), (False, True, "by repair"), (False, False, "no")]
)
def test_only_what_was_to_be_repaired_recovers_by_repair(recovered: bool, by_repair: bool, told: str) -> None:
    nothing = ReactionTimes(None, None)
    outcome = Outcome("x", "x", "x", "x", (), "", "FAULT", nothing, 0, recovered, (), Loss.NONE, None, by_repair)
    assert cells(outcome)[HEADER.index("Recovered")] == told


def test_interrupted_it_writes_what_it_has(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servod.qualify.faults import run as campaign

    def interrupted(chosen: dict, jobs: int) -> Iterator[Outcome]:
        for name, scenario in chosen.items():
            yield campaign.outcome_of(name, scenario)
            raise KeyboardInterrupt

    second = mine.with_name("second.yaml")
    second.write_text(mine.read_text())
    monkeypatch.setattr(campaign, "outcomes", interrupted)
    out = mine.parent / "out"
    files = ["--scenario", str(mine), "--scenario", str(second)]
    assert run(["qualify", "faults", *files, "--out", str(out)]) == 130
    assert json.loads((out / "faults.json").read_text())["run"] == 1
    assert "1 of 2 were not run." in capsys.readouterr().out


def test_what_does_not_get_to_the_start_has_failed(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine.write_text(mine.read_text() + "config: {amplifier: {identity: {serial: 77}}}\n")
    assert run(["qualify", "faults", "--scenario", str(mine), "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)["scenarios"]
    assert row["axis"] == "not started"
    assert "is another device" in row["complaints"][0]
