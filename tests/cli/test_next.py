"""The last line of a command on a terminal: what is sensible next, as a command that exists."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from servod.cli.app import command, run
from servod.cli.common import suggest
from servod.cli.groups import NEXT


def leaves(node: Any, path: tuple[str, ...] = ()) -> list[str]:
    """Every command that does something."""
    if not hasattr(node, "commands"):
        return [" ".join(path)]
    shown = {name: child for name, child in node.commands.items() if not child.hidden}
    return [leaf for name, child in shown.items() for leaf in leaves(child, (*path, name))]


class Terminal:
    """Types commands at a terminal, and reads what stands on it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *words: str, code: int = 0) -> str:
        """Standard output."""
        with self._monkeypatch.context() as context:
            context.setattr(sys.stdout, "isatty", lambda: True)
            assert run(list(words)) == code
        return self._capsys.readouterr().out


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Terminal:
    """In place of the pipe that pytest is."""
    return Terminal(monkeypatch, capsys)


def test_every_command_has_a_next_one() -> None:
    assert set(NEXT) == set(leaves(command()))


@pytest.mark.parametrize("line", sorted({line.partition("   #")[0] for line in NEXT.values()}))
def test_the_next_one_is_a_command_with_these_options(line: str) -> None:
    program, *words = shlex.split(line)
    assert program == "servoctl"
    node = command()
    while words and hasattr(node, "commands"):
        node = node.commands[words.pop(0)]
    known = {option for parameter in node.params for option in (*parameter.opts, *parameter.secondary_opts)}
    given = [word for word in words if word.startswith("--")]
    assert not hasattr(node, "commands") and set(given) <= known
    needed = {parameter.opts[0] for parameter in node.params if parameter.required and parameter.opts[0][0] == "-"}
    assert needed <= set(given)


def test_a_terminal_is_told_and_a_pipe_a_document_and_a_help_are_not(
    terminal: Terminal, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["explain", "stribeck"]) == 0
    assert "next:" not in capsys.readouterr().out
    assert terminal("explain", "stribeck").splitlines()[-1] == f"next: {NEXT['explain']}"
    for words in (["explain", "stribeck", "--json"], ["explain", "--help"], ["--version"]):
        assert "next:" not in terminal(*words)


def test_no_next_one_after_a_no(terminal: Terminal) -> None:
    assert terminal("config", "check", "/nowhere.yaml", code=2) == ""


def test_a_stage_of_another_command_says_nothing(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SERVOCTL_LOCKED_FOLDERS", "")
    assert "next:" not in terminal("explain", "stribeck")


def test_what_a_command_knows_better_takes_the_place_of_the_usual(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("servod.cli.explain._print", lambda _document: suggest("x", "a b", why="why"))
    assert terminal("explain", "stribeck") == "next: servoctl x 'a b'   # why\n"


@pytest.mark.parametrize(
    ("axis", "told"),
    [
        ({"state": "FAULT", "motion_running": False}, "servoctl faults"),
        ({"state": "ENABLED", "motion_running": True}, "servoctl status --watch"),
        ({"state": "ENABLED", "motion_running": False}, "servoctl track sine "),
        ({"state": "DISABLED", "motion_running": False}, NEXT["status"]),
    ],
)
def test_after_a_status_comes_what_its_state_asks_for(
    axis: dict[str, Any], told: str, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def daemon(_socket: object) -> Iterator[Any]:
        yield SimpleNamespace(call=lambda _verb: {"axis": axis})

    monkeypatch.setattr("servod.cli.status.connect", daemon)
    monkeypatch.setattr("servod.cli.status.screen", lambda _document: "")
    assert terminal("status").splitlines()[-1].startswith(f"next: {told}")
