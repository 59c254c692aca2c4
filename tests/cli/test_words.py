"""Small texts of the verbs: what is missing or old is said in words, and no figure stands for it."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import pytest

from servod.cli import scan
from servod.cli.app import run
from servod.cli.common import table_console
from servod.cli.status import screen
from servod.cli.track import _where, _why
from servod.common.errors import BadInput
from servod.common.files import reason
from servod.common.units import counted
from servod.common.yaml import parse_yaml
from servod.lab.recordings.recording import load_recording
from servod.qualify.blind.conceal import BlindTrial
from servod.qualify.soak.document import verdict
from tests.cli.test_status_screen import document


def test_a_node_without_a_serial_number_has_a_dash(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """CiA 301 asks for 0x1018:1 alone."""
    identity = {"device_type": 402, "vendor_id": 0x2A, "product_code": None, "revision": None, "serial": None}
    nodes = [{"node_id": 5, "identity": identity, "lss": None, "name": "drive"}]
    monkeypatch.setattr(scan, "_through_daemon", lambda _socket: nodes)
    assert run(["scan"]) == 0
    text = capsys.readouterr().out
    assert "0x2A" in text and "None" not in text
    assert run(["scan", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nodes"] == nodes


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (
            {"stale": False, "reference_rad": 0.1, "following_error_rad": 0.002},
            "reference +0.1000 rad, error +2.000 mrad",
        ),
        ({"stale": True, "reference_rad": 0.1, "following_error_rad": 0.002}, "no feedback of the joint"),
        ({"stale": False, "reference_rad": None, "following_error_rad": None}, ""),
    ],
)
def test_the_progress_of_a_motion_shows_no_old_error(motion: dict[str, Any], says: str) -> None:
    assert _where(motion) == says


def test_no_line_of_a_screen_is_broken_in_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The title of the status and of its table, and the tables of demo and soak."""
    from servod.cli.demo import print_document
    from servod.cli.qualify import _print
    from servod.qualify.demo.entries import DemoRow

    monkeypatch.delenv("COLUMNS", raising=False)
    status = document()
    status["axis"]["reasons"] = [f"reason {k} that the drive is not ready" for k in range(20)]
    table_console().print(screen(status))
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("reason 19 that the drive is not ready")
    assert any(line.rstrip() == "cycle 12345, 3 missed; last 10 s in µs" for line in lines)

    label = "a controller with a name " * 12
    row = DemoRow(name="pd", label=label.strip(), options="x" * 200, gains=Path("pd.yaml"))
    score = {"rms_error_mrad": 1.0, "max_error_mrad": 2.0}
    rest = {"cycles": 1, "missed": 0, "wall_s": 1.0, "realtime_refused": [], "report": "r.html"}
    print_document([row], {"controllers": {"pd": score}, **rest})
    assert any(label.strip() in line and "x" * 200 in line for line in capsys.readouterr().out.splitlines())

    long = "a fault with a name " * 15
    monkeypatch.setattr("servod.qualify.soak.document.fault_rows", lambda _: [(long.strip(), *"123456789")])
    monkeypatch.setattr("servod.qualify.soak.document.count_rows", lambda _: [("cycles", "1")])
    monkeypatch.setattr("servod.qualify.soak.document.verdict", lambda _: "passed")
    _print({"findings": []}, Path("out"))
    assert any(long.strip() in line for line in capsys.readouterr().out.splitlines())


def test_no_table_in_a_pipe_cuts_off_a_key(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert run(["faults", "--codes"]) == 0
    text = capsys.readouterr().out
    assert "…" not in text
    assert "limits.torque_rate_nm_per_s" in text and "limits.position_min_rad" in text


def test_only_a_fault_that_stops_is_why_a_motion_ended() -> None:
    warning = {"code": "DEADLINE_LATE", "reaction": "NONE", "cause": "Cycles started late."}
    fault = {"code": "DRIVE_RESET", "reaction": "DISABLE", "cause": "A node was reset."}
    nobody = {"lease": {"stopped_by": None}}
    assert _why({"faults": [warning], **nobody}) == "it was stopped or disabled"
    assert _why({"faults": [warning, fault], **nobody}) == "DRIVE_RESET: A node was reset."


def test_a_name_in_the_words_of_the_system_keeps_its_capitals() -> None:
    assert reason(OSError("AF_UNIX path too long")) == "AF_UNIX path too long"
    assert reason(OSError(errno.ENOENT, "No such file")) == "no such file"
    assert reason(OSError(errno.EIO, "I/O error")) == "I/O error"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('a: "x" y', "a text where none may stand"),
        ("a:\n  - 1\n b: 2", "keys that are indented otherwise than those before"),
        ("a: [1,", "the end of the file, where more must come"),
        ("- a\nb: 1", "a key where none may stand"),
    ],
)
def test_a_broken_file_is_told_in_its_own_words(text: str, says: str) -> None:
    with pytest.raises(BadInput) as caught:
        parse_yaml(text, "x.yaml")
    assert caught.value.found == says


def test_a_noun_stands_with_its_count() -> None:
    assert [counted(n, "recording") for n in (0, 1, 2)] == ["0 recordings", "1 recording", "2 recordings"]
    assert str(BlindTrial(1, 9, False)) == "1 case of seed 9"
    document = {"cycles": 2553, "axis_hours": 0.0007, "faults_injected": 1, "wrong": {}, "excused": {}}
    assert (
        verdict(document | {"unproven": [], "untold": []})
        == "Nothing wrong in 2,553 cycles (2.52 s of axis time), 1 fault."
    )


def test_a_recording_that_is_cut_to_nothing_tells_no_none(tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    file.write_text("t_s,torque_nm,position_rad\n" + "".join(f"{0.001 * k:.3f},0,0\n" for k in range(2000)))
    whole = load_recording(file)
    for span, says in (((None, 0.0), "0 rows from its start to 0 s"), ((1.999, None), "1 row from 1.999 s to its end")):
        with pytest.raises(BadInput) as caught:
            whole.between(*span)
        assert caught.value.found == says
