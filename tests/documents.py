"""Every JSON document that a command prints in a test, held against what the reference says of it.

`described` watches `servoctl` as it is called within a test, so that no test of a verb has to ask for it: a key that
docs/reference/json.md does not have fails the test that printed it. tests/tools/documents.yaml is what that page is
written from.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import yaml

_FILE = Path(__file__).parent / "tools" / "documents.yaml"
#: Options with which a verb prints another document.
_OTHER = ("--codes", "--diagnose", "--attack")
_ENTRY, _ANY, _BELOW = "[]", "NAME", "**"

#: Where a value stands in a document: keys, and `[]` for each entry of a list.
Place = tuple[str, ...]


class Leaf(NamedTuple):
    """A value that is no group, with its place; `empty` stands for a group or list that may have more in it."""

    place: Place
    empty: bool


@cache
def documents() -> dict[str, dict[str, str]]:
    """What each command prints: key -> meaning, by its words."""
    found: dict[str, dict[str, str]] = yaml.safe_load(_FILE.read_text())
    return found


@cache
def places(command: str) -> tuple[Place, ...]:
    """The keys of a command's document as places."""
    return tuple(
        tuple(word for part in key.split(".") for word in _words(part)) for key in documents().get(command, {})
    )


def _words(part: str) -> Iterator[str]:
    if part != _ENTRY:
        yield part.removesuffix(_ENTRY)
    if part.endswith(_ENTRY):
        yield _ENTRY


def leaves(value: Any, place: Place = ()) -> Iterator[Leaf]:
    """Every value of a document; a list of plain values is one."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from leaves(inner, (*place, key))
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        for inner in value:
            yield from leaves(inner, (*place, _ENTRY))
    else:
        yield Leaf(place, empty=value is None or value in ({}, []))


def undescribed(command: str, document: Any) -> list[str]:
    """Keys of a document that the reference does not have."""
    if isinstance(document, dict) and set(document) == {"error"}:
        command = "error"
    told = places(command)
    return sorted({".".join(leaf.place) for leaf in leaves(document) if not any(_fits(leaf, place) for place in told)})


def _fits(leaf: Leaf, told: Place) -> bool:
    if told[-1] == _BELOW and len(leaf.place) >= len(told):
        return _alike(leaf.place, told[:-1])
    if leaf.empty and len(leaf.place) < len(told):
        return _alike(told[: len(leaf.place)], leaf.place)
    return len(leaf.place) == len(told) and _alike(leaf.place, told)


def _alike(one: Place, other: Place) -> bool:
    """Whether two places are the same as far as the shorter one goes."""
    return all(_ANY in (a, b) or a == b for a, b in zip(one, other, strict=False))


def command_of(words: Sequence[str]) -> str:
    """The command whose document these words of a command line print."""
    found = "servoctl"
    for word in words:
        if word.startswith("-") or not any(name.startswith(f"{found} {word}") for name in documents()):
            break
        found += f" {word}"
    other = next((option for option in _OTHER if option in words and f"{found} {option}" in documents()), "")
    return f"{found} {other}".strip()


@pytest.fixture(autouse=True)
def described() -> Iterator[None]:
    """Fails a test in which `servoctl`, called within it, printed a key that the reference does not have."""
    app = sys.modules.get("servod.cli.app")
    if app is None:
        yield
        return
    real, words, missing = app.command, list[str](), list[str]()

    def noted() -> Any:
        def call(args: list[str], **more: Any) -> Any:
            words[:] = args
            return real()(args=args, **more)

        return call

    def dumps(document: Any, **more: Any) -> str:
        if words:  # printed by a command line, not by a test that stands in for one
            command = command_of(words)
            missing.extend(f"{command}: {key}" for key in undescribed(command, document))
        return json.dumps(document, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(app, "command", noted)
        patch.setattr("servod.cli.common.json", SimpleNamespace(dumps=dumps, loads=json.loads))
        yield
    assert missing == [], f"docs/reference/json.md does not say what these are (tests/tools/documents.yaml): {missing}"
