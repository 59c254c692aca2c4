"""Under --json an error is one document on standard output, beside the line on standard error."""

from __future__ import annotations

import json
import socket
import threading
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
    assert list(error) == ["code", "exit_code", "message", "where", "found", "allowed"]
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


USAGE = {
    "out of range": (["track", "paper", "--duration", "0"], "--duration", "0", "greater than or equal to 0.001"),
    "after an equals sign": (["verify", "g.yaml", "--plants=many"], "--plants", "many", "a valid integer"),
    "not a choice": (
        ["synthesize", "--model", "m", "--out", "o", "--mode", "x"], "--mode", "x", "one of 'deployed', 'reference'",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("words", "where", "found", "allowed"), USAGE.values(), ids=list(USAGE))
def test_a_wrong_value_of_an_option_reads_as_every_other_refusal(
    words: list[str], where: str, found: str, allowed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    error = told([*words, "--json"], 2, capsys)
    assert (error["where"], error["found"], error["allowed"]) == (where, found, allowed)
    verb = " ".join(word for word in words[:2] if not word.startswith("-") and "." not in word)
    assert error["message"] == f"{where}: found {found}; allowed: {allowed}; see `servoctl {verb} --help`"


def test_a_misspelt_verb_is_a_sentence_with_the_next_step(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(["stat", "--json"], 2, capsys)["message"] == (
        "No such command 'stat'. Did you mean 'status'? See `servoctl --help`"
    )


@pytest.mark.parametrize("told_apart", [True, False], ids=["this daemon", "an older one"])
def test_bad_input_that_the_daemon_found_has_its_parts(
    told_apart: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A daemon that answers one request with bad input."""
    from servod.common.errors import BadInput
    from servod.runtime.daemon.connection import Reply

    bad, answers = BadInput("track: frequency_hz", -1.0, "greater than 0"), list[dict[str, Any]]()
    Reply(answers.append, 1).failed(bad)
    if not told_apart:
        answers[0]["error"] = {key: answers[0]["error"][key] for key in ("exit_code", "message")}
    path = tmp_path / "axis.sock"

    def answer() -> None:
        client, _ = listening.accept()
        with client:
            client.recv(65_536)
            client.sendall(json.dumps(answers[0]).encode() + b"\n")

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen(1)
        daemon = threading.Thread(target=answer)
        daemon.start()
        error = told(["enable", "--socket", str(path), "--json"], 2, capsys)
        daemon.join()
    parts = ("track: frequency_hz", "-1.0", "greater than 0") if told_apart else ("daemon", str(bad), None)
    assert (error["where"], error["found"], error["allowed"]) == parts and error["message"] == str(bad)


@pytest.mark.parametrize("words", WITH_SOCKET, ids=" ".join)
def test_no_daemon_is_a_document(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert told([*words, "--socket", str(tmp_path / "none"), "--json"], 3, capsys)["code"] == "unreachable"


def test_no_such_verb_is_a_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert told(["dance", "--json"], 2, capsys)["code"] == "usage"
    assert told(["preset", "axis.yaml", "--json"], 2, capsys)["where"] == "--position-rad"


def test_every_verb_has_json() -> None:
    groups = {path[:-1] for path in COMMANDS}
    assert set(COMMANDS) - set(WITH_JSON) <= groups


def test_what_nobody_foresaw_is_a_document_and_a_trace(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken() -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("servod.lab.diagnose.explain.list_effects", broken)
    with pytest.raises(ZeroDivisionError):
        run(["explain", "--json"])
    error = json.loads(capsys.readouterr().out)["error"]
    unknown = {"where": None, "found": None, "allowed": None}
    assert error == {"code": "internal", "exit_code": 1, "message": "ZeroDivisionError: by zero"} | unknown


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
