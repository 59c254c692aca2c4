"""What the README says of the code is what the code says."""

from __future__ import annotations

import re

import readme
import source

from servod.cli.app import app

TEXT = readme.README.read_text()


def test_the_tables_are_current() -> None:
    """`python tests/house/readme.py` writes them anew."""
    assert readme.with_tables(TEXT) == TEXT


def test_every_servoctl_command_that_is_shown_exists() -> None:
    verbs = {c.name for c in app.registered_commands} | {g.name for g in app.registered_groups}
    shown = set(re.findall(r"servoctl ([a-z]+)", TEXT))
    assert shown and shown - verbs == set()


def test_every_file_that_is_named_exists() -> None:
    named = set(re.findall(r"`((?:servod|drivers|gains|systemd|tests|scripts)/[\w./@-]+)`", TEXT))
    missing = [name for name in named if not (source.ROOT / name).exists()]
    assert named and missing == []


def test_the_two_commands_stand_in_it_and_run_on_their_own() -> None:
    commands = re.findall(r"^ {4}(\./\w+)(?: |$)", TEXT, re.MULTILINE)
    assert "./demo" in commands and "./test" in commands
    for name in ("demo", "test"):
        assert (source.ROOT / name).stat().st_mode & 0o111
