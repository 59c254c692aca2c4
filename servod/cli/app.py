"""`servoctl`: the command line for commissioning. One file per verb; each imports what it needs only when it runs.

Stands above everything else and holds nothing that acts by itself: it talks to the daemon over its control socket, or
works on files alone. Exit codes are those of servod.common.errors: 0 done, 1 the answer is no, 2 bad input, 3
unreachable.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
from functools import cache
from importlib import import_module
from itertools import pairwise
from typing import Any

import typer
from typer.main import get_command

from servod import __version__
from servod.cli.common import begin_command, drop_empty_folders, say_next
from servod.cli.errors import INTERRUPTED, complain, say
from servod.cli.groups import NEXT, Grouped, modules
from servod.common.errors import BadInput

#: Windows says EINVAL of a pipe whose reader has gone.
_GONE = {errno.EPIPE, errno.EINVAL} if sys.platform == "win32" else {errno.EPIPE}
_NOBODY_TAKES = {errno.ENOSPC, errno.EIO, errno.EBADF, *_GONE}

app = typer.Typer(
    name="servoctl",
    cls=Grouped,
    help="Commission and run servo axes under servod. Every command's --help shows an example.",
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _module in modules():
    import_module(f"servod.cli.{_module}").register(app)


def _print_version(asked: bool) -> None:
    if asked:
        print(f"servoctl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    _version: bool = typer.Option(
        False, "--version", is_eager=True, callback=_print_version, help="Print the version."
    ),
) -> None:
    """What `servoctl` takes before a verb; its help is the app's."""


def main() -> None:
    """Entry point of `servoctl`: errors become one line on standard error and an exit code, never a traceback."""
    _stand_in_for_closed()
    logging.getLogger("servod").addHandler(logging.NullHandler())  # the daemon's parts log; here they are only used
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without the character still gets the rest
    try:
        code = run(sys.argv[1:])
        sys.stdout.flush()
    except OSError as error:
        code = _output_refused(error)
    sys.exit(code)


def _stand_in_for_closed() -> None:
    """A stream that the caller closed (`>&-`) is None: standard output gets one that refuses what is written to it, and
    standard error one that takes everything. The lowest free number is theirs, so that no later file gets it."""
    if sys.stdout is None:
        sys.stdout = os.fdopen(os.open(os.devnull, os.O_RDONLY), "w")
    if sys.stderr is None:
        sys.stderr = os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")


def _output_refused(error: OSError) -> int:
    """The exit code when nobody takes standard output; any other error is raised again."""
    if not _is_of_output(error):
        raise error
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes once more
    if error.errno in _GONE:
        return 1  # the reader of a pipe has gone; nothing is left to say
    say(f"standard output: {error.strerror}")
    return 1


def _is_of_output(error: OSError) -> bool:
    return error.filename is None and error.errno in _NOBODY_TAKES


@cache
def command() -> Any:
    """All verbs as one command of click; building it takes longer than most of them run."""
    return get_command(app)


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code."""
    begin_command()
    try:
        _refuse_empty(arguments)
        code = command()(args=arguments, prog_name="servoctl", standalone_mode=False)
        if code == INTERRUPTED:  # typer turns Ctrl-C within a command into this
            raise KeyboardInterrupt
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, OSError) and _is_of_output(error):
            raise
        return complain(error, arguments)
    finally:
        drop_empty_folders()
    if not code:
        _say_next(arguments)
    return code if isinstance(code, int) else 0


def _say_next(arguments: list[str]) -> None:
    """After a command that did its work: a help, a version and a document are no work to go on from."""
    words = [text for text in arguments[:2] if not text.startswith("-")]
    usual = NEXT.get(" ".join(words)) or NEXT.get(words[0] if words else "")
    if usual and not {"-h", "--help", "--json"} & set(arguments):
        say_next(usual)


def _refuse_empty(arguments: list[str]) -> None:
    """An empty text is never meant: for a file or folder it would stand for the current one. Raises BadInput."""
    for before, text in pairwise(["argument", *arguments]):
        option = before if not text else text[:-1] if text.startswith("--") and text.endswith("=") else None
        if option is not None:
            raise BadInput(option, "an empty text", "a value")
