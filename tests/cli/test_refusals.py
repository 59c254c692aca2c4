"""What a refused command says and leaves behind, beyond the one line of bad_inputs.yaml."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import threading
from pathlib import Path

import pytest
import yaml

from servod.cli.app import run
from servod.client.control import RemoteBadInput
from servod.common.errors import BadInput, details
from servod.formats.config import RecorderConfig
from servod.formats.gains.gain_set import parse_gains
from servod.lab.commission.state import State
from servod.runtime.daemon.recorder import RecordingFiles
from tests.formats.gains import good
from tests.fuzz.recordings import recorded
from tests.lab.diagnose.axes import BELIEVED, believed, record, write_csv


def test_deploy_announces_no_motion_before_its_inputs_are_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, gains = str(tmp_path / "plant.yaml"), tmp_path / "gains.yaml"
    gains.write_text(good.certified(parse_gains(good.PD, "good")).to_yaml())
    assert run(["deploy", str(gains), "--plant", missing]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert missing in line and "mrad" not in line


@pytest.mark.parametrize("asked", [["--socket", "nowhere.sock", "--config", "axis.yaml"], ["--config", "axis.yaml"]])
def test_a_refused_command_leaves_no_folder(
    asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SERVOD_SOCKET", "nowhere.sock")
    limits = dict.fromkeys(("torque_nm", "torque_rate_nm_per_s", "speed_rad_s", "following_error_rad"), 1.0)
    limits |= {"position_min_rad": -1.0, "position_max_rad": 1.0, "encoder_mismatch_rad": 0.1}
    Path("axis.yaml").write_text(yaml.safe_dump({"limits": limits, "gains": {"initial": "gains.yaml"}}))
    assert run(["identify", "--out", "deep/down/model.yaml", *asked]) == 3, capsys.readouterr()
    assert [entry.name for entry in tmp_path.iterdir()] == ["axis.yaml"]


def test_the_other_configuration_of_a_folder_is_told_where_it_differs(tmp_path: Path) -> None:
    before = {"configuration": {"name": "axis", "text": "x" * 100 + "one"}}
    State(tmp_path, before, [])
    with pytest.raises(BadInput) as caught:
        State(tmp_path, {"configuration": {"name": "axis", "text": "x" * 100 + "two"}}, [])
    assert "configuration.text: found ...xxxxxxxxxxxxxxxxxxxxtwo; allowed: ...xxxxxxxxxxxxxxxxxxxxone, " in str(
        caught.value
    )


def test_gains_show_gives_the_seals_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sealed = good.certified(parse_gains(good.PD, "good"))
    whole, changed = tmp_path / "whole.yaml", tmp_path / "changed.yaml"
    whole.write_text(sealed.to_yaml())
    changed.write_text(sealed.model_copy(update={"seal": "0" * 64}).to_yaml())
    for file, says in ((whole, None), (changed, "numbers that were changed after")):
        assert run(["gains", "show", str(file), "--json"]) == 0
        problem = json.loads(capsys.readouterr().out)["seal_problem"]
        assert problem is None if says is None else says in problem
    assert run(["gains", "show", str(changed)]) == 0
    assert "seal: numbers that were changed" in capsys.readouterr().out


@pytest.mark.parametrize(("kept", "what"), [(0.7, "cut off"), (1.0, "damaged")])
def test_a_damaged_recording_tells_how_much_could_be_read(
    kept: float, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = bytearray(recorded(tmp_path / "whole.mcap"))
    at = content.find(b"zstd") + 60
    if kept == 1.0:
        content[at] ^= 0xFF
    file, table = tmp_path / "run.mcap", tmp_path / "run.csv"
    file.write_bytes(content if kept == 1.0 else content[: content.rfind(b"zstd")])
    code = run(["record", "export", str(file), "--out", str(table)])
    said = " ".join(capsys.readouterr())
    assert (code, what in said, f"of {file.stat().st_size} bytes" in said) in ((0, True, True), (2, True, True)), said


def test_a_folder_that_another_command_works_in_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, inputs = tmp_path / "out", tmp_path / "inputs"
    out.mkdir()
    inputs.mkdir()
    other = os.open(out, os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        made = record(believed(), seconds=2.0)[0]
        write_csv(made, inputs / "run.csv")
        (inputs / "axis.yaml").write_text(yaml.safe_dump(BELIEVED))
        for command in (
            ["qualify", "soak", "--cycles", "1"],
            ["qualify", "faults", "--stepped"],
            ["qualify", "paper", "--quick"],
            ["demo", "--diagnose", "--fast"],
            ["prove", "--cases", "1"],
            ["diagnose", "--model", str(inputs / "axis.yaml"), str(inputs / "run.csv")],
        ):
            assert run([*command, "--out", str(out)]) == 3
            assert f"--out {out}: another command is at work there" in capsys.readouterr().err
    finally:
        os.close(other)
    assert not list(out.iterdir())


def _hang_up(listening: socket.socket) -> None:
    listening.accept()[0].close()


def test_who_stops_an_axis_is_told_when_the_answer_is_late(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel takes the connection of a daemon that is stopped; nobody answers."""
    monkeypatch.setattr("servod.cli.common._LATE_S", 0.05)
    path = tmp_path / "axis.sock"
    with socket.socket(socket.AF_UNIX) as hung:
        hung.bind(str(path))
        hung.listen(1)
        threading.Timer(0.5, _hang_up, [hung]).start()
        assert run(["stop", "--socket", str(path)]) == 3
    first, *_ = capsys.readouterr().err.splitlines()
    assert "stop: no answer yet" in first and "EMERGENCY STOP" in first


def test_a_number_that_is_not_finite_is_told_with_its_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "axis.sock"
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.bind(str(path))
        daemon.listen(1)
        words = ["--amplitude", "0.1", "--frequency", "inf", "--duration", "1", "--no-wait", "--socket", str(path)]
        assert run(["track", "sine", *words]) == 2
    assert "track: frequency_hz: found inf; allowed: finite numbers" in capsys.readouterr().err


def test_a_name_of_a_recording_that_is_refused_is_told_by_its_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    files = RecordingFiles(RecorderConfig(directory=tmp_path), "axis")

    def daemon(_socket: Path, _verb: str, path: str) -> dict[str, str]:
        try:
            return {"path": str(files.recording(path))}
        except BadInput as error:
            raise RemoteBadInput(str(error), *details(error)) from None

    monkeypatch.setattr("servod.cli.record.ask", daemon)
    assert run(["record", "start", "--name", "_a b_1.,+()-.mcap"]) == 0
    assert run(["record", "start", "--name", "a:b.mcap", "--json"]) == 2
    shown = capsys.readouterr()
    assert (
        "servoctl: --name: found 'a:b.mcap'; allowed: a file name that ends in .mcap, of letters, digits, _ and"
        in shown.err
    )
    assert json.loads(shown.out[shown.out.index("{") :])["error"]["where"] == "--name"
