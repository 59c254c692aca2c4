"""`servoctl faults`: what befell this axis, from the daemon, from fault files, from log lines."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from servod.cli.app import run
from servod.common.faults import FAULTS, FaultCode
from servod.formats.config import RecorderConfig
from servod.formats.recording.incidents import Incident, Seen, moment, newest
from servod.formats.recording.run_mark import RunMark
from servod.runtime.daemon.fault_watch import FaultWatch
from servod.runtime.daemon.health import Health
from servod.runtime.daemon.metrics import AxisMetrics
from servod.runtime.daemon.recorder import Recorder
from servod.runtime.loop.axis_state import AxisState

sys.path.insert(0, str(Path(__file__).parents[1] / "daemon"))
from tests.runtime.daemon.daemon_rows import record, row

BLOCKED, LATE = FaultCode.FOLLOWING_ERROR, FaultCode.DEADLINE_LATE
CLIPPED, LEFT = FaultCode.TORQUE_CLIPPED, FaultCode.DRIVE_LEFT_OPERATION


def word(*codes: FaultCode) -> int:
    return sum(FAULTS[code].bit for code in codes)


def story(watch: FaultWatch, recorder: Recorder, start: int = 0) -> None:
    """An old fault, an enable, a clip 100 ms before the axis is blocked, and a drive that gives up 20 ms later."""
    faults = {0: word(LATE), 900: word(CLIPPED), 1000: word(CLIPPED, BLOCKED), 1020: word(BLOCKED, LEFT)}
    latched, now = word(LATE), 0
    for cycle in range(1500):
        now = faults.get(cycle, now)
        state = AxisState.ENABLING if 300 <= cycle < 320 else AxisState.ENABLED
        latched = 0 if cycle == 300 else latched | now
        if cycle == 300:
            now = 0
        values = {"faults": now, "faults_latched": latched, "axis_state": state}
        time_ns = time.monotonic_ns() + (cycle - 1500) * 1_000_000 if start == 0 else start + cycle * 1_000_000
        recorder.add_rows([row(cycle, **values, time_ns=time_ns)])
        watch.see([record(cycle, **values, time_ns=time_ns)], cycle * 1_000_000)
        watch.tick(cycle * 1_000_000)
    watch.tick(10**10)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The recordings of an axis that was stopped once."""
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=2.0), "joint", 1000)
    story(FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("joint", 0.4), "joint"), recorder, time.monotonic_ns())
    recorder.close()
    return tmp_path


def test_faults_of_one_stop_are_one_incident_however_far_apart(tmp_path: Path, capsys) -> None:
    """A blocked joint first, and 12 s later, with nobody having enabled it, the drive gives up."""
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=30.0), "joint", 1000)
    watch = FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("joint", 0.4), "joint")
    for cycle in range(0, 14_000, 10):
        faults = word(BLOCKED) if cycle < 12_500 else word(BLOCKED, LEFT)
        state = AxisState.ENABLED if cycle < 500 else AxisState.FAULT
        values = {"faults": faults if cycle >= 500 else 0, "faults_latched": faults if cycle >= 500 else 0}
        time_ns = (cycle + 1) * 1_000_000
        recorder.add_rows([row(cycle, **values, axis_state=state, time_ns=time_ns)])
        watch.see([record(cycle, **values, axis_state=state, time_ns=time_ns)], time_ns)
        watch.tick(time_ns)
    watch.tick(10**12)
    recorder.close()
    newest = max(tmp_path.glob("joint-fault-*.mcap"), key=lambda path: path.stat().st_size)
    (incident,) = told([str(newest)], capsys)["incidents"]
    assert incident["code"] == "FOLLOWING_ERROR"
    assert {other["code"] for other in incident["faults"]} == {"FOLLOWING_ERROR", "DRIVE_LEFT_OPERATION"}


def told(words: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert run(["faults", *words, "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


def test_a_fault_file_tells_the_first_cause_and_what_followed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = told(["--recordings", str(folder)], capsys)
    (row,) = document["incidents"]
    (file,) = folder.glob("joint-fault-*-FOLLOWING_ERROR.mcap")
    assert (row["axis"], row["code"], row["file"]) == ("joint", "FOLLOWING_ERROR", str(file))
    assert row["cause"] == FAULTS[BLOCKED].cause and row["remedy"] == FAULTS[BLOCKED].remedy
    followed = {other["code"]: other["after_s"] for other in row["faults"]}
    assert followed == pytest.approx({"TORQUE_CLIPPED": -0.1, "FOLLOWING_ERROR": 0.0, "DRIVE_LEFT_OPERATION": 0.02})
    assert row["time"][:10] == time.strftime("%Y-%m-%d") and document["now"] is None
    assert told([str(file)], capsys)["incidents"] == document["incidents"]


def test_people_read_when_what_and_where(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["faults", "--recordings", str(folder)]) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert f"joint: FOLLOWING_ERROR (ramp down). {FAULTS[BLOCKED].cause}" in first
    assert rest[0].strip() == "0.100 s before: TORQUE_CLIPPED (clip)"
    assert rest[1].strip() == "0.020 s later: DRIVE_LEFT_OPERATION (disable)"
    assert rest[2].strip() == f"to do: {FAULTS[BLOCKED].remedy}"
    assert rest[3].strip().startswith("the seconds before: ")


def test_a_file_that_cannot_be_read_hides_no_other(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = folder / "joint-fault-29990101-000000-BUS_OFF.mcap"
    broken.write_bytes(b"nothing")
    (folder / "joint-20260101-000000.mcap").write_bytes(b"a recording, no fault file")
    document = told(["--recordings", str(folder)], capsys)
    assert len(document["incidents"]) == 1 and str(broken) in document["not_read"][0]


def test_a_run_without_an_orderly_end_is_among_what_happened(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As after kill -9: nobody ends the mark, and nobody holds it."""
    for axis in ("joint", "other"):
        with pytest.raises(ZeroDivisionError), RunMark(folder, axis):
            raise ZeroDivisionError
    (folder / "damaged.run.json").write_text("{")
    document = told(["--recordings", str(folder)], capsys)
    assert sorted((row["axis"], row["code"]) for row in document["incidents"]) == [
        ("joint", "DAEMON_LOST"), ("joint", "FOLLOWING_ERROR"), ("other", "DAEMON_LOST"),
    ]  # fmt: skip
    assert "damaged.run.json" in document["not_read"][0]
    assert run(["faults", "--recordings", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert shown.count("servod ended without an orderly stop") == 2 and "[last known to live at 20" in shown


def test_the_time_of_a_loss_is_not_that_of_who_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ZeroDivisionError), RunMark(tmp_path, "joint"):
        raise ZeroDivisionError
    now_ns, asked = time.time_ns(), list[dict[str, Any]]()
    seen = moment((tmp_path / "joint.run.json").stat().st_mtime_ns)
    for later_s in (3600, 7200):
        monkeypatch.setattr(time, "time_ns", lambda later_s=later_s: now_ns + later_s * 10**9)
        asked += told(["--recordings", str(tmp_path)], capsys)["incidents"]
    assert [(row["time"], row["detail"]) for row in asked] == [(seen, f"last known to live at {seen}")] * 2
    with RunMark(tmp_path, "joint"):
        monkeypatch.setattr(time, "time_ns", lambda: now_ns + 9000 * 10**9)
        (kept,) = told(["--recordings", str(tmp_path)], capsys)["incidents"]
    assert kept["detail"].endswith(f", found ended by the start at {moment(now_ns + 7200 * 10**9)}")


def test_no_fault_is_an_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["faults", "--recordings", str(tmp_path)]) == 0
    assert capsys.readouterr().out == "no fault is on record\n"


LINES = f"""\
2026-03-01T10:00:00.250000+01:00 host servod[7]: fault TORQUE_CLIPPED (CLIP): {FAULTS[CLIPPED].cause} x | lag
2026-03-01T10:00:00.500000+01:00 host servod[7]: fault BUS_OFF (DISABLE): {FAULTS[FaultCode.BUS_OFF].cause} [32 sent] y
2026-03-01T10:00:01+0100 host servod[7]: somebody else's line
2026-03-01T12:00:00+0100 host servod[7]: fault RECORDER_FAILED (NONE): The recording could not be written. [full] z
"""


def test_saved_log_lines_tell_it_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = tmp_path / "journal.txt"
    journal.write_text(LINES)
    later, first = told(["--journal", str(journal)], capsys)["incidents"]
    assert (first["code"], first["detail"]) == ("BUS_OFF", "32 sent")
    assert [(f["code"], f["after_s"]) for f in first["faults"]] == [("TORQUE_CLIPPED", -0.25), ("BUS_OFF", 0.0)]
    assert (later["code"], later["detail"]) == ("RECORDER_FAILED", "full")
    assert len(told(["--journal", str(journal), "--last", "1"], capsys)["incidents"]) == 1
    journal.write_text("-- No entries --\n")
    assert told(["--journal", str(journal)], capsys)["incidents"] == []
    journal.write_text("# A page\n\nof something else, in which nobody logs.\n")
    assert run(["faults", "--journal", str(journal)]) == 2
    assert "no line with a date" in capsys.readouterr().err
    journal.write_text("Mar 01 10:00:00 host servod[7]: fault BUS_OFF (DISABLE): x\n")
    assert run(["faults", "--journal", str(journal)]) == 2
    assert "a line without its date" in capsys.readouterr().err


def test_the_daemons_own_log_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logger, log = logging.getLogger("servod.faults"), tmp_path / "servod.log"
    handler = logging.FileHandler(log)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=0.1), "joint", 1000)
    try:
        FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("joint", 0.4)).see([record(1, faults=word(BLOCKED))], 0)
    finally:
        logger.removeHandler(handler)
        recorder.close()
    (row,) = told(["--journal", str(log)], capsys)["incidents"]
    assert row["code"] == "FOLLOWING_ERROR" and row["detail"] == ""


def test_the_daemon_remembers_incidents_and_their_files(tmp_path: Path) -> None:
    recorder = Recorder(RecorderConfig(directory=tmp_path, history_s=2.0), "joint", 1000)
    watch = FaultWatch(recorder, Health(1000, 0.4), AxisMetrics("joint", 0.4), "joint")
    story(watch, recorder)
    deadline = time.monotonic() + 10.0
    while not any(row["file"] for row in watch.incidents()) and time.monotonic() < deadline:
        watch.tick(10**11)
        threading.Event().wait(0.02)
    late, blocked = watch.incidents()
    (file,) = tmp_path.glob("joint-fault-*.mcap")
    assert (late["code"], late["file"], blocked["code"], blocked["file"]) == (
        "DEADLINE_LATE", "", "FOLLOWING_ERROR", str(file),
    )  # fmt: skip
    assert [f["code"] for f in blocked["faults"]] == ["TORQUE_CLIPPED", "FOLLOWING_ERROR", "DRIVE_LEFT_OPERATION"]
    watch.raise_own(FaultCode.RECORDER_FAILED, "no space")
    assert watch.incidents()[-1]["faults"][-1]["detail"] == "no space"
    recorder.close()


def test_an_incident_that_stands_in_two_files_is_told_once_with_all_that_followed() -> None:
    lost, followed = Seen(10**18, FaultCode.SUPERVISOR_LOST), Seen(10**18 + 10**9, FaultCode.LOOP_LOST)
    rows = [Incident("a", [lost], "1.mcap"), Incident("a", [lost, followed], "2.mcap"), Incident("b", [lost])]
    assert [(row.axis, row.file) for row in newest(rows, 9)] == [("a", "2.mcap"), ("b", "")]
    assert newest(rows, 1)[0].faults


def test_the_first_cause_is_the_strongest_of_its_cycle() -> None:
    seen = [Seen(5, CLIPPED), Seen(10, BLOCKED), Seen(10, LEFT), Seen(20, FaultCode.BUS_OFF)]
    assert Incident("", seen).first.code is LEFT
    assert Incident("", seen[:1]).first.code is CLIPPED


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["--socket", "none"], 3, "there is no folder of recordings"),
        (["--socket", "none"], 3, "another one: --config AXIS.yaml, or --recordings FOLDER"),
        (["--recordings", "none"], 2, "none: there is no such folder"),
        (["--codes", "--journal", "x"], 2, "--codes: found beside --journal"),
        (["--recordings", "a", "--journal", "x"], 2, "--journal: found beside --recordings"),
        (["none.mcap"], 2, "none.mcap: there is no such file"),
    ],
)
def test_nowhere_to_look_is_one_line(
    words: list[str], code: int, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("servod.cli.faults._FOLDER", tmp_path / "nowhere")
    assert run(["faults", *words]) == code
    (shown,) = capsys.readouterr().err.splitlines()
    assert line in shown


def test_where_no_daemon_answers_the_folder_that_is_read_is_named_and_how_to_name_another(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("servod.cli.faults._FOLDER", folder)
    assert run(["faults", "--socket", str(folder / "none")]) == 0
    first, *_ = capsys.readouterr().out.splitlines()
    assert "no daemon answers" in first and f"fault files in {folder} (another one: --config AXIS.yaml" in first


@pytest.mark.parametrize("name", ["soak", "paper"])
def test_the_old_names_say_where_they_are_now(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--out", "/proc/nowhere"]) == 2
    moved, refused = capsys.readouterr().err.splitlines()
    assert f"`servoctl {name}` is `servoctl qualify {name}` now" in moved and "--out /proc/nowhere" in refused
    assert run(["--help"]) == 0
    assert f"\n  {name} " not in capsys.readouterr().out
