"""`servoctl`: the command line for commissioning. One file per verb; each imports what it needs only when it runs.

Stands above everything else and holds nothing that acts by itself: it talks to the daemon over its control socket, or
works on files alone. Exit codes are those of servod.common.errors: 0 done, 1 the answer is no, 2 bad input, 3
unreachable.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shlex
import sys
from itertools import pairwise

import typer

from servod import __version__
from servod.cli import (
    bench,
    check,
    commission,
    demo,
    deploy,
    diagnose,
    enable,
    explain,
    faults,
    gains,
    identify,
    paper,
    preset,
    prove,
    record,
    replay,
    scan,
    soak,
    status,
    stop,
    synthesize,
    track,
    verify,
)
from servod.cli.common import drop_empty_folders
from servod.common.errors import BadInput, ServodError

_INTERRUPTED = 130  # as shells count SIGINT
#: Windows says EINVAL of a pipe whose reader has gone.
_GONE = {errno.EPIPE, errno.EINVAL} if sys.platform == "win32" else {errno.EPIPE}
_NOBODY_TAKES = {errno.ENOSPC, errno.EIO, errno.EBADF, *_GONE}

app = typer.Typer(
    name="servoctl",
    help="Commission and run servo axes under servod. Every command's --help shows an example.",
    no_args_is_help=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_DAEMON = (demo, scan, status, enable, stop, track, gains, preset, record)
_LABORATORY = (identify, synthesize, verify, deploy, commission, replay, diagnose, explain, prove, paper)
for _verb in (*_DAEMON, *_LABORATORY, soak, bench, check, faults):
    _verb.register(app)


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
    if error.filename is not None or error.errno not in _NOBODY_TAKES:
        raise error
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes once more
    if error.errno in _GONE:
        return 1  # the reader of a pipe has gone; nothing is left to say
    return _complain(f"standard output: {error.strerror}", 1)


def run(arguments: list[str]) -> int:
    """Run one command line and return its exit code."""
    try:
        _refuse_empty(arguments)
        code = app(args=arguments, prog_name="servoctl", standalone_mode=False)
    except ServodError as error:
        return _complain(str(error), error.exit_code)
    except ImportError as error:
        if not _of_the_lab(error):
            raise
        command = shlex.join(["servoctl", *arguments])
        return _complain(f"`{command}` needs servod[lab]: pip install 'servod[lab]' ({error.name} is missing)", 2)
    except typer.TyperException as error:
        return _complain(f"{error.format_message()} Found: `{shlex.join(['servoctl', *arguments])}`; see --help.", 2)
    except (KeyboardInterrupt, typer.Abort):
        code = _INTERRUPTED
    finally:
        drop_empty_folders()
    if code == _INTERRUPTED:  # typer turns Ctrl-C within a command into this
        return _complain("interrupted", _INTERRUPTED)
    return code if isinstance(code, int) else 0


def _refuse_empty(arguments: list[str]) -> None:
    """An empty text is never meant: for a file or folder it would stand for the current one. Raises BadInput."""
    for before, text in pairwise(["argument", *arguments]):
        option = before if not text else text[:-1] if text.startswith("--") and text.endswith("=") else None
        if option is not None:
            raise BadInput(option, "an empty text", "a value")


def _of_the_lab(error: ImportError) -> bool:
    """Whether the missing package is one that only the extra `lab` installs, as servod's own metadata says."""
    from importlib.metadata import requires

    package = re.escape((error.name or "?").partition(".")[0])
    return any(re.match(rf"{package}\b.*\bextra == .lab\b", line) for line in requires("servod") or ())


def _complain(message: str, exit_code: int) -> int:
    print("servoctl: " + " ".join(message.split()), file=sys.stderr)
    return exit_code
