"""Every command explains itself with an example, and the examples are commands that exist."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from importlib.metadata import version

import pytest
from typer.main import get_command

from servod.cli.app import app, run


def commands(node: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The path of every command below a group, the groups included."""
    for name, child in getattr(node, "commands", {}).items():
        if child.hidden:
            continue
        yield (*path, name)
        yield from commands(child, (*path, name))


COMMANDS = sorted(commands(get_command(app)))
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

    monkeypatch.setattr("servod.qualify.demo.fast.run_fast", interrupted)
    assert run(["demo", "--fast", "--json"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "servoctl: interrupted\n"
    told = {"code": "interrupted", "exit_code": 130, "message": "interrupted"}
    assert json.loads(captured.out) == {"error": told}


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
