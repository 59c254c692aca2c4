"""The commands that the manual shows: which of them are run, why the others are not, and a shell that runs them.

A fenced block of `sh` in docs/tutorials and docs/how-to says what becomes of it by a comment. Directly above a block it
is that block's, with an empty line below it that of all blocks that follow and have none:

    <!-- run -->                          as it stands, after the blocks above it on the page
    <!-- run: on an axis -->              the same, with a virtual axis and its daemon running, as the README begins
    <!-- run: after first-axis.md -->     after the blocks of another page, in the same shell
    <!-- run: long -->                    takes longer than a developer waits for: ./test -m long
    <!-- not run: REASON -->              needs a drive, root, another system, somebody's data

Options of `run` may stand together, with commas. What runs on a page runs in one shell, which ends at the first error.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE
from typing import NamedTuple

import readme
import source

FOLDERS = ("tutorials", "how-to")
_MARK = re.compile(r"^ *<!-- (?P<not>not )?run(?:: (?P<words>.*?))? -->$")
_FENCE = re.compile(r"^(?P<indent> *)```(?P<kind>\w*)$")
_WALK = re.compile(r"^<!-- walk -->\n```sh\n(.*?)^```\n<!-- walk: end -->$", re.DOTALL | re.MULTILINE)
#: Where the first steps of the README have an axis and begin to use it.
_BEGINS = "servoctl scan\n"
#: Folders of the checkout that commands of the manual name.
_NAMED = ("gains", "examples", "scripts")


class Mark(NamedTuple):
    """What becomes of blocks: `run`, and options or the reason."""

    run: bool
    words: tuple[str, ...]


class Block(NamedTuple):
    """One block of commands and its line; without a mark nobody has said what becomes of it."""

    page: Path
    line: int
    text: str
    mark: Mark | None

    def __str__(self) -> str:
        return f"{self.page.relative_to(source.ROOT)}:{self.line}"


def pages() -> list[Path]:
    """The pages whose commands are looked at."""
    return [page for folder in FOLDERS for page in sorted((readme.DOCS / folder).rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """Every `sh` block of a page, in order."""
    found: list[Block] = []
    inside: re.Match[str] | None = None
    lines: list[str] = []
    below: Mark | None = None
    here: Mark | None = None
    for number, line in enumerate(page.read_text().splitlines(), start=1):
        fence = _FENCE.match(line)
        if inside is not None:
            if fence and not fence["kind"]:
                if inside["kind"] == "sh":
                    text = "".join(f"{one.removeprefix(inside['indent'])}\n" for one in lines)
                    found.append(Block(page, number - len(lines) - 1, text, here or below))
                inside, here = None, None
            else:
                lines.append(line)
        elif fence:
            inside, lines = fence, []
        elif mark := _mark(line):
            here = mark
        elif not line.strip() and here is not None:
            below, here = here, None
    return found


def _mark(line: str) -> Mark | None:
    match = _MARK.match(line)
    if match is None:
        return None
    words = match["words"] or ""
    return Mark(not match["not"], (words,) if match["not"] else tuple(filter(None, words.split(", "))))


def options(page: Path) -> set[str]:
    """The options of all blocks of a page that are run."""
    return {word for block in blocks(page) if block.mark and block.mark.run for word in block.mark.words}


def runs(page: Path) -> bool:
    """Whether anything of a page is run."""
    return any(block.mark and block.mark.run for block in blocks(page))


def script(page: Path) -> str:
    """What is run of a page in one shell, behind the axis or the page that it wants before it."""
    asked = options(page)
    before = first_steps().partition(_BEGINS)[0] if "on an axis" in asked else ""
    for word in sorted(asked):
        if word.startswith("after "):
            before += script(page.parent / word.removeprefix("after "))
    return before + "".join(block.text for block in blocks(page) if block.mark and block.mark.run)


def first_steps() -> str:
    """The walk of the README, to the letter: who copies these lines gets the same ones."""
    (found,) = _WALK.findall(readme.README.read_text())
    return str(found)


def run(text: str, folder: Path, timeout_s: float) -> str:
    """Run `text` in `folder`, as in a checkout whose commands are those of this Python; what it printed.

    Fails at the first command that does, and leaves nothing running.
    """
    for name in _NAMED:
        if (source.ROOT / name).exists():
            (folder / name).symlink_to(source.ROOT / name)
    (folder / ".venv").symlink_to(sys.prefix)
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    shell = ["bash", "-e", "-c", "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + text]
    begun = subprocess.Popen(
        shell, cwd=folder, env=environment, stdout=PIPE, stderr=PIPE, text=True, start_new_session=True
    )
    try:
        told, complained = begun.communicate(timeout=timeout_s)
    finally:  # also what the shell started and a time-out leaves behind
        with contextlib.suppress(ProcessLookupError):
            os.killpg(begun.pid, signal.SIGKILL)
    assert begun.returncode == 0, told + complained
    return told
