"""`servoctl prove` as it is typed: its stages are processes of their own, and work in the folder that it has locked."""

from __future__ import annotations

import fcntl
import os
import subprocess
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.qualify.blind.conceal import BlindTrial, foreign_in, write_trial
from tests.cli.test_output import servoctl

_OPTIONS = ("--cases", "1", "--seed", "1")


def prove(out: Path) -> subprocess.CompletedProcess[bytes]:
    return servoctl("prove", *_OPTIONS, "--out", str(out), stdout=subprocess.PIPE)


def test_a_stage_comes_to_its_work_in_the_folder_of_its_command(tmp_path: Path) -> None:
    write_trial(tmp_path, BlindTrial(3, 9, harder=True))  # the first stage looks into it, and refuses
    done = prove(tmp_path)
    assert done.stderr.decode() == (
        f"servoctl: {tmp_path}/trial.json: found 3 cases of seed 9, harder; "
        "allowed: the same trial, or another folder\n"
    )
    assert done.returncode == 2


def test_another_command_in_the_folder_keeps_this_one_out(tmp_path: Path) -> None:
    """Also one that claims a lock which it was not given: the number of some open file is not enough."""
    held = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(held, fcntl.LOCK_EX)
        other = os.open(tmp_path, os.O_RDONLY)
        claims = os.environ | {"SERVOCTL_LOCKED_FOLDERS": f"{other} 0 999 x"}
        done = prove(tmp_path)
        claimed = servoctl("prove", *_OPTIONS, "--out", str(tmp_path), env=claims, pass_fds=[other])
        os.close(other)
    finally:
        os.close(held)
    for refused in (done, claimed):
        assert (refused.returncode, refused.stderr.count(b"another command is at work there")) == (3, 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("stage", ["conceal", "cases"])
def test_a_folder_of_other_origin_is_left_alone(tmp_path: Path, stage: str) -> None:
    for name in ("a.txt", "b.txt", "c.txt", "d.txt"):
        (tmp_path / name).write_text("mine")
    done = servoctl("prove", *_OPTIONS, "--only", stage, "--out", str(tmp_path), stdout=subprocess.PIPE)
    assert done.stderr.decode() == (
        f"servoctl: --out {tmp_path}: found a.txt, b.txt, c.txt and 1 more; "
        "allowed: an empty folder, or one of an earlier `servoctl prove`\n"
    )
    assert done.returncode == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "b.txt", "c.txt", "d.txt"]


def test_an_own_folder_is_known_by_its_trial_or_by_what_an_interrupted_one_left(tmp_path: Path) -> None:
    (tmp_path / "cases").mkdir()
    (tmp_path / "c007").mkdir()
    assert foreign_in(tmp_path) == [] == foreign_in(tmp_path / "none")
    (tmp_path / "notes.txt").touch()
    assert foreign_in(tmp_path) == ["notes.txt"]
    write_trial(tmp_path, BlindTrial(3, 9, harder=True))
    assert foreign_in(tmp_path) == []


@pytest.mark.parametrize(
    ("environment", "said"), [({}, "servoctl: interrupted\n"), ({"SERVOCTL_LOCKED_FOLDERS": ""}, "")]
)
def test_an_interrupt_that_comes_to_command_and_stage_is_told_once(
    environment: dict[str, str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(**_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("servod.cli.app.command", lambda: interrupted)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert run(["prove", "--out", "x"]) == 130
    assert capsys.readouterr().err == said
