"""What the README says of the code is what the code says."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from subprocess import PIPE

import pytest
import readme
import source

from servod.cli.app import app
from servod.qualify.paper.table import QUANTITIES

TEXT = readme.README.read_text()


def test_the_tables_are_current() -> None:
    """`python tests/tools/readme.py` writes them anew."""
    assert readme.with_tables(TEXT) == TEXT


def test_the_papers_table_has_the_rows_that_are_printed() -> None:
    (part,) = re.findall(r"<!-- paper: from the code -->\n(.*?)<!-- paper: end -->", TEXT, re.DOTALL)
    numbers = part.split("\n\n")[0].splitlines()[2:]
    assert tuple(line.split(" | ")[0].removeprefix("| ") for line in numbers) == QUANTITIES


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


@pytest.mark.serial
def test_the_first_steps_work_as_they_stand(tmp_path: Path) -> None:
    """Every line between the marks, by a shell that ends at the first error; the commands are those of this Python."""
    (block,) = re.findall(r"<!-- walk -->\n(.*?)<!-- walk: end -->", TEXT, re.DOTALL)
    (tmp_path / "gains").symlink_to(source.ROOT / "gains")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    shell = ["bash", "-e", "-c", "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + textwrap.dedent(block)]
    begun = subprocess.Popen(
        shell, cwd=tmp_path, env=environment, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True
    )
    try:
        told, complained = begun.communicate(timeout=100)
    finally:  # also what the shell started and a time-out leaves behind
        with contextlib.suppress(ProcessLookupError):
            os.killpg(begun.pid, signal.SIGKILL)
    assert begun.returncode == 0, told + complained
    assert told.count("motion done") == 2
    assert "open-loop position error" in told
