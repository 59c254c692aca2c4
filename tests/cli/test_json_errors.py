"""Under --json an error is one document on standard output, beside the line on standard error."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servod.cli.app import command, run
from tests.cli.test_help import COMMANDS


def options_of(path: tuple[str, ...]) -> set[str]:
    node: Any = command()
    for name in path:
        node = node.commands[name]
    return {option for param in node.params for option in param.opts}


WITH_JSON = [path for path in COMMANDS if "--json" in options_of(path)]
WITH_SOCKET = [
    *(["status"], ["enable"], ["disable"], ["stop"], ["gains", "list"], ["gains", "rollback"], ["record", "start"]),
    *(["record", "stop"], ["scan"], ["track", "paper"], ["gains", "activate", "pd"]),
]
BAD = {
    "missing file": (["replay", "--model", "none.yaml", "r.csv"], "bad_file", "none.yaml"),
    "bad value": (["replay", "--model", "none.yaml", "r.csv", "--horizon", "x"], "bad_input", "--horizon"),
    "empty text": (["explain", ""], "bad_input", "explain"),
    "unknown effect": (["explain", "friction"], "bad_input", "EFFECT"),
    "bad number": (["verify", "gains.yaml", "--plants", "many"], "usage", "--plants"),
    "out of range": (["track", "paper", "--duration", "0"], "usage", "--duration"),
    "not a choice": (["synthesize", "--model", "m", "--out", "o", "--mode", "x"], "usage", "--mode"),
    "missing option": (["diagnose", "run.csv", "--model", "m.yaml"], "usage", "--out"),
    "missing argument": (["verify"], "usage", "gains"),
}


def told(words: list[str], code: int, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The error of the one document, whose message is the one line."""
    assert run(words) == code
    shown = capsys.readouterr()
    (line,) = shown.err.splitlines()
    (name, error), *others = json.loads(shown.out).items()
    assert (name, others, error["exit_code"]) == ("error", [], code)
    assert line == f"servoctl: {error['message']}"
    found: dict[str, Any] = error
    return found


@pytest.mark.parametrize("path", WITH_JSON, ids=" ".join)
@pytest.mark.parametrize("before", [True, False], ids=["--json before", "--json after"])
def test_an_unknown_option_is_a_document(
    path: tuple[str, ...], before: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--json", "--wrong"] if before else ["--wrong", "--json"]
    error = told([*path, *words], 2, capsys)
    assert (error["code"], error["where"]) == ("usage", "--wrong")


@pytest.mark.parametrize(("words", "code", "where"), BAD.values(), ids=list(BAD))
def test_bad_input_says_where(
    words: list[str], code: str, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    error = told([*words, "--json"], 2, capsys)
    assert (error["code"], error["where"]) == (code, where)
    assert code == "usage" or (error["found"] and error["allowed"])


@pytest.mark.parametrize("words", WITH_SOCKET, ids=" ".join)
def test_no_daemon_is_a_document(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told([*words, "--socket", str(tmp_path / "none"), "--json"], 3, capsys)["code"] == "unreachable"


def test_no_such_verb_is_a_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(["dance", "--json"], 2, capsys)["code"] == "usage"
    assert told(["preset", "axis.yaml", "--json"], 2, capsys)["where"] == "--json"


def test_what_nobody_foresaw_is_a_document_and_a_trace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("servod.lab.diagnose.explain.list_effects", broken)
    with pytest.raises(ZeroDivisionError):
        run(["explain", "--json"])
    error = json.loads(capsys.readouterr().out)["error"]
    assert error == {"code": "internal", "exit_code": 1, "message": "ZeroDivisionError: by zero"}


def test_without_json_standard_output_stays_empty(capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["explain", "friction"], ["explain", "--", "--json"]):
        assert run(words) == 2
        assert capsys.readouterr().out == ""


def test_an_answer_that_is_no_has_its_own_document_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servod.cli import verify as verb
    from servod.common.errors import AnswerIsNo

    def answered(**_: object) -> None:
        verb.print_json({"valid": False})
        raise AnswerIsNo("not valid")

    monkeypatch.setattr("servod.cli.app.command", lambda: lambda **_: answered())
    assert run(["verify", "x", "--json"]) == 1
    shown = capsys.readouterr()
    assert json.loads(shown.out) == {"valid": False} and shown.err == "servoctl: not valid\n"
