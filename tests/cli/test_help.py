"""Every command explains itself with an example, and the examples are commands that exist."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from importlib.metadata import version
from typing import Any

import pytest

from servod.cli.app import command, run
from servod.cli.groups import VERBS as VERBS_SHOWN


def commands(node: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every command below a group, the groups included."""
    for name, child in getattr(node, "commands", {}).items():
        if child.hidden:
            continue
        yield (*path, name)
        yield from commands(child, (*path, name))


def at(path: tuple[str, ...]) -> Any:
    """The command or group at a path."""
    node: Any = command()
    for name in path:
        node = node.commands[name]
    return node


COMMANDS = sorted(commands(command()))
VERBS = {"demo", "scan", "status", "enable", "disable", "stop", "track", "gains", "record", "replay", "bench", "config"}


def help_of(path: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> str:
    assert run([*path, "--help"]) == 0
    return capsys.readouterr().out


def test_every_verb_is_there() -> None:
    assert {path[0] for path in COMMANDS} >= VERBS


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_shows_an_example_that_is_a_command(path: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(path, capsys)
    examples = re.findall(r"^ +servoctl (.+)$", text.partition("Example")[2], re.MULTILINE)
    assert examples
    for line in examples:
        words = shlex.split(line)
        assert tuple(words[: len(path)]) == path
        options = re.findall(r"--[a-z-]+", line)
        deepest = max((p for p in COMMANDS if tuple(words[: len(p)]) == p), key=len)
        shown = help_of(deepest, capsys)
        assert all(option in shown for option in options)


@pytest.mark.parametrize("path", [p for p in COMMANDS if p in {("faults",), ("status",), ("scan",), ("bench",)}])
def test_reading_commands_have_json(path: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert "--json" in help_of(path, capsys)


def test_an_interrupt_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("servod.qualify.demo.runs.run_fast", interrupted)
    assert run(["demo", "--fast", "--json"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "servoctl: interrupted\n"
    told = {"code": "interrupted", "exit_code": 130, "message": "interrupted"}
    assert json.loads(captured.out) == {"error": told | dict.fromkeys(("where", "found", "allowed"))}


def test_bench_refuses_a_folder_that_cannot_be_before_it_measures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def measured(*_: object) -> None:
        pytest.fail("the benchmark ran")

    monkeypatch.setattr("servod.qualify.bench.measure", measured)
    assert run(["bench", "--out", "/proc/nowhere/bench.json"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--out /proc/nowhere" in line


def test_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"servoctl {version('servod')}\n"


@pytest.mark.parametrize("path", [(), *(p for p in COMMANDS if hasattr(at(p), "commands"))], ids=" ".join)
def test_every_verb_has_a_whole_line(path: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(path, capsys)
    assert max(map(len, text.splitlines())) <= 80
    for name in (p[len(path)] for p in COMMANDS if len(p) == len(path) + 1 and p[: len(path)] == path):
        (line,) = re.findall(rf"^  {name} +(\S.*)$", text, re.MULTILINE)
        assert len(line) > 10 and not line.endswith("...")


def test_verbs_stand_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of((), capsys)
    assert re.findall(r"^(\w+):$", text, re.MULTILINE) == ["Options", "Operate", "Commission", "Analyse", "Qualify"]
    listed = {name for lines in VERBS_SHOWN.values() for name in lines}
    assert listed == {path[0] for path in COMMANDS}


def complete(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What bash is offered at the end of the line."""
    monkeypatch.setenv("_SERVOCTL_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    with pytest.raises(SystemExit):
        run([])
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("servoctl di", ["disable", "diagnose"]),
        ("servoctl explain strib", ["stribeck"]),
        ("servoctl demo --conceal cogg", ["cogging"]),
        ("servoctl synthesize --mode ", ["deployed", "reference"]),
        ("servoctl synthesize --weights ", ["linear", "cosine", "gaussian"]),
        ("servoctl replay --start re", ["rest", "recorded"]),
        ("servoctl replay --horizon f", ["full"]),
        ("servoctl scan --interface socketcan", ["socketcan", "socketcand"]),
        ("servoctl track s", ["sine", "step"]),
        ("servoctl qualify ", ["faults", "soak", "paper"]),
        ("servoctl qualify faults --group enc", ["encoder"]),
        ("servoctl commission --again ver", ["verify"]),
        ("servoctl prove --only c", ["conceal", "cases"]),
        ("servoctl gains activate --socket /nowhere ", []),
    ],
)
def test_the_shell_completes_closed_sets(
    line: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert complete(line, monkeypatch, capsys) == offered


def test_the_shell_completes_names_of_stored_sets(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Daemon:
        def __init__(self, path: object, timeout_s: float) -> None:
            assert str(path) == "here.sock" and timeout_s <= 1.0

        def __enter__(self) -> Daemon:
            return self

        def __exit__(self, *_: object) -> None: ...

        def call(self, _verb: str) -> dict[str, list[dict[str, str]]]:
            return {"gains": [{"name": name} for name in ("stiff", "soft", "plain", "soft")]}

    monkeypatch.setattr("servod.client.control.ControlClient", Daemon)
    assert complete("servoctl gains activate --socket here.sock s", monkeypatch, capsys) == ["soft", "stiff"]
