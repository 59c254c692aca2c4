"""The reference of the command line: every verb, argument and option, from the three programs themselves."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import typer
from tables import code, markdown, prose

from servod.cli.app import command
from servod.cli.groups import VERBS
from servod.drivers.virtual import main as virtual_axis
from servod.runtime.daemon import main as daemon

#: What an option takes, in words; numbers have their range beside them.
_VALUES = {"str": "text", "list[str]": "text", "list[Path]": "path", "int range": "int", "float range": "float"}
_EXTRA = re.compile(r"^(.*?)(?:  \[(.*)\])?$", re.DOTALL)


class Row(NamedTuple):
    """One argument or option: as it is typed, what it takes, default, what is allowed, meaning."""

    name: str
    value: str
    default: str
    allowed: str
    meaning: str


class Verb(NamedTuple):
    """One command: its words, what it does, examples, and what it takes."""

    words: str
    text: str
    examples: list[str]
    rows: list[Row]


def verbs() -> Iterator[Verb]:
    """Every verb that the help of `servoctl` shows, in its order; a group of verbs before those in it."""
    root = command()
    context = typer.Context(root, info_name="servoctl")
    for name in root.list_commands(context):
        yield from _verbs(root.commands[name], f"servoctl {name}", context)


def _verbs(found: Any, words: str, above: Any) -> Iterator[Verb]:
    if found.hidden:
        return
    context = typer.Context(found, info_name=words.rsplit(maxsplit=1)[-1], parent=above)
    text, _, examples = (found.help or "").partition("\n\nExample:\n\n\b\n")
    rows = [_row(param, *param.get_help_record(context)) for param in found.params]
    yield Verb(words, text, [line.strip() for line in examples.splitlines()], rows)
    for name, inner in getattr(found, "commands", {}).items():
        yield from _verbs(inner, f"{words} {name}", context)


def _row(param: Any, shown: str, text: str) -> Row:
    """From what --help prints of it: name and value, then the meaning with default and range behind it in brackets."""
    match = _EXTRA.match(text)
    meaning, extra = (match[1], match[2] or "") if match else (text, "")
    known = dict(part.partition(": ")[::2] for part in extra.split("; ") if part)
    default = "required" if known.pop("required", None) is not None else known.pop("default", "")
    variable = known.pop("env var", "")
    name, _, value = shown.partition(" <")
    value = value.removesuffix(">")
    allowed = [f"`{bound}`" for bound in known] + ([f"the variable `{variable}`"] if variable else [])
    if "|" in value:
        value, allowed = "", [f"`{word}`" for word in value.split("|")]
    if param.param_type_name == "argument":
        value = ""
    return Row(name, _VALUES.get(value, value), default, ", ".join(allowed), meaning)


def _parsed(parser: argparse.ArgumentParser) -> list[Row]:
    """The options of a program that argparse reads."""
    found = []
    for action in parser._actions:
        if "--help" in action.option_strings:
            continue
        name = ", ".join(action.option_strings)
        choices = action.choices
        allowed = ", ".join(f"`{choice}`" for choice in choices) if isinstance(choices, list | tuple) else ""
        if isinstance(choices, range):
            allowed = f"{choices.start} to {choices.stop - 1}"
        default = "required" if action.required else _default(action.default)
        found.append(Row(name, str(action.metavar or ""), default, allowed, action.help or ""))
    return found


def _default(value: object) -> str:
    return "" if value in (None, False, argparse.SUPPRESS) else str(value)


def _section(verb: Verb) -> str:
    parts = [f"### {verb.words}", prose(verb.text)]
    if verb.examples:
        parts.append("```sh\n" + "\n".join(verb.examples) + "\n```")
    if verb.rows:
        parts.append(_table(verb.rows))
    return "\n\n".join(parts)


def _table(rows: list[Row]) -> str:
    """Each with what it takes; the default as it would be typed."""
    shown = [
        [f"`{' '.join(filter(None, row[:2]))}`", code(row.default), row.allowed, prose(row.meaning)] for row in rows
    ]
    return markdown(["Option or argument", "Default", "Allowed", "Meaning"], shown)


def servoctl() -> str:
    """All verbs below the titles of their panels."""
    every = {verb.words: verb for verb in verbs()}
    parts = []
    for panel, lines in VERBS.items():
        parts.append(f"## {panel}")
        parts += [_section(verb) for words, verb in every.items() if words.split()[1] in lines]
    return "\n\n".join(parts)


def servod() -> str:
    """The options of the daemon."""
    return _table(_parsed(daemon.parser()))


def servod_virtual_axis() -> str:
    """The options of the virtual axis."""
    return _table(_parsed(virtual_axis.parser()))
