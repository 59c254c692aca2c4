"""A file that cannot be had is told as a person would say it, and never in the words of the C library."""

from __future__ import annotations

import errno
import json
import os
import re
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.common.errors import BadInput
from servod.common.files import read_bytes, unreadable, unwritable

#: Of what exactly the line ends with; {file} is the one that was asked for.
COMMANDS = {
    "missing model": (["replay", "--model", "none.yaml", "run.csv"], "none.yaml: there is no such file"),
    "missing recording": (["replay", "--model", "model.yaml", "none.csv"], "none.csv: there is no such file"),
    "missing gain set": (["gains", "show", "none.yaml"], "none.yaml: there is no such file"),
    "missing recording of servod's": (["record", "export", "none.mcap", "--out", "x.csv"], "there is no such file"),
    "missing EDS": (["config", "check", "none.eds"], "there is no such file; needed: an EDS or DCF file"),
    "folder for a model": (["config", "check", "folder"], "folder: is a folder, a file is needed"),
    "folder for a recording": (["replay", "--model", "model.yaml", "folder"], "is a folder, a file is needed"),
    "folder for a result": (["synthesize", "--model", "m.yaml", "--out", "folder"], "is a folder, a file is needed"),
    "below a file": (["gains", "show", "model.yaml/x.yaml"], "for a part of this path is a file itself"),
    "pipe": (["config", "check", "pipe"], "pipe: cannot be read (a pipe, which might not end)"),
    "result in a folder that is missing": (
        ["replay", "--model", "model.yaml", "run.csv", "--out", "none/x.csv"],
        "--out none/x.csv: there is no such folder to write it in",
    ),
    "folder below a file": (
        ["diagnose", "--model", "model.yaml", "run.csv", "--out", "model.yaml"],
        "--out model.yaml: a file stands where a folder is needed",
    ),
    "name that is too long": (["plot", "run.csv", "--out", f"{'a' * 300}.html"], "the name is too long"),
    "links in a circle": (
        ["identify", "--plant", "model.yaml", "--out", "circle/model.yaml"],
        "--out circle/model.yaml: its links go round in a circle",
    ),
    "trial at links in a circle": (
        ["prove", "--out", "circle"],
        "--out circle: a file stands where a folder is needed",
    ),
    "no daemon": (["status", "--socket", "none"], "no daemon answers (there is no such socket); is servod running?"),
    "no trial": (["prove", "--only", "score", "--out", "trial"], "there is no such file; needed: a folder in which"),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    friction = "friction: {kind: coulomb_viscous, coulomb: 0.04, viscous: 0.02}"
    Path("model.yaml").write_text(f"inertia: 0.001\n{friction}\n")
    rows = [f"{0.001 * k:.3f},0.0,0.0" for k in range(2000)]
    Path("run.csv").write_text("\n".join(["t_s,torque_nm,position_rad", *rows]))
    Path("folder").mkdir()
    os.mkfifo("pipe")
    Path("circle").symlink_to("circle")
    return tmp_path


@pytest.mark.parametrize("words", [["config", "check", "model.yaml"], ["faults", "--recordings", "folder"]])
def test_what_may_not_be_read_is_told_so(words, files, monkeypatch, capsys) -> None:
    monkeypatch.setattr(os, "access", lambda *_args, **_options: False)  # as for everybody but root
    assert run([*words, "--json"]) == 2
    told = capsys.readouterr()
    assert told.err == f"servoctl: {words[-1]}: may not be read (permission denied)\n"
    assert json.loads(told.out)["error"]["code"] == "bad_file"


@pytest.mark.parametrize(("words", "told"), COMMANDS.values(), ids=list(COMMANDS))
def test_commands_say_it_in_a_sentence(
    words: list[str], told: str, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == (3 if words[0] == "status" else 2)
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line
    assert "; allowed:" not in line
    assert not any(text in line for text in ("No such", "Not a dir", "Is a dir", "File exists", "Errno"))


@pytest.mark.parametrize("home", ["/proc", "/sys", "model.yaml"])
def test_a_home_that_takes_no_completion_is_told_with_the_file(
    home: str, files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", home if home.startswith("/") else str(files / home))
    assert run(["--install-completion", "bash"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(rf"servoctl: \S*{home}(/\.bashrc)?: \w", line) and "folder to write it in" not in line


def test_every_error_of_the_system_has_a_sentence() -> None:
    for number in errno.errorcode:
        error = OSError(number, os.strerror(number))
        for refusal in (unreadable("x.yaml", error), unwritable("x.yaml", error)):
            assert isinstance(refusal, BadInput) and refusal.exit_code == 2
            assert str(refusal).startswith("x.yaml: ") and not str(refusal).startswith("x.yaml: found")


def test_permission_denied_is_not_told_of_a_folder(tmp_path: Path) -> None:
    """Windows says so of every folder that is opened as a file."""
    denied = PermissionError(errno.EACCES, "Permission denied")
    assert str(unreadable(tmp_path, denied)) == f"{tmp_path}: is a folder, a file is needed"
    assert str(unreadable(tmp_path / "x", denied)) == f"{tmp_path / 'x'}: may not be read (permission denied)"
    assert str(unwritable(tmp_path / "x", denied)) == f"{tmp_path / 'x'}: may not be written (permission denied)"


def test_a_name_that_is_none() -> None:
    with pytest.raises(BadInput, match="is no name of a file"):
        read_bytes("a\0b")
