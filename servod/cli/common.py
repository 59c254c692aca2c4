"""What several verbs share: the options for socket and JSON, and how results are printed.

Imports typer alone, so that `servoctl --help` starts at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import stat
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servod.common.errors import BadInput, Unreachable
from servod.common.files import BadFile, reason, unwritable
from servod.common.portable import lock_again, lock_folder
from servod.common.progress import OnProgress

if TYPE_CHECKING:
    from rich.console import Console

    from servod.client.control import ControlClient

DEFAULT_SOCKET = Path("/run/servod/axis.sock")

SocketOption = Annotated[
    Path,
    typer.Option(
        "--socket",
        envvar="SERVOD_SOCKET",
        readable=False,  # a socket that refuses is "unreachable", not bad usage
        help="Control socket of the axis's daemon.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]


def connect(socket: Path) -> ControlClient:
    """A client of the daemon at `socket`; raises Unreachable when nobody listens there."""
    from servod.client.control import ControlClient

    return ControlClient(socket)


def ask(socket: Path, verb: str, **arguments: Any) -> dict[str, Any]:
    """The result of one verb of the daemon at `socket`. Raises as the daemon's answer says."""
    with connect(socket) as client:
        result: dict[str, Any] = client.call(verb, **arguments)
    return result


def ask_to_stop(socket: Path, verb: str) -> dict[str, Any]:
    """The same for what brings the axis to rest: who stands beside it is told when the answer is late."""
    late = threading.Timer(
        _LATE_S, print, [f"servoctl: {verb}: no answer yet; {_BESIDE_THE_AXIS}"], {"file": sys.stderr}
    )
    late.daemon = True
    late.start()
    try:
        return ask(socket, verb)
    finally:
        late.cancel()


def print_json(document: Any) -> None:
    """Print `document` as the one JSON document of a command."""
    text = json.dumps(document, indent=2, allow_nan=False)
    _printed.append(True)
    sys.stdout.write(text + "\n")


def json_is_printed() -> bool:
    """Whether this command has printed its document."""
    return bool(_printed)


def begin_command() -> None:
    """Forget what an earlier command of this process printed."""
    _printed.clear()
    _suggested.clear()


def suggest(*words: str, why: str = "") -> None:
    """The words of `servoctl` that are sensible next, where that depends on what this command did.

    Shown at its end on a terminal, in place of what servod.cli.groups.NEXT has for it.
    """
    _suggested[:] = [f"next: servoctl {shlex.join(words)}" + (f"   # {why}" if why else "")]


def say_next(usual: str) -> None:
    """The last line of a command on a terminal; a pipe, a document and a stage of another command get none."""
    if sys.stdout.isatty() and not _printed and not is_stage():
        print(*(_suggested or [f"next: {usual}"]))


#: A stop is answered when the drive has stopped. One that takes longer [s] is a slow ramp, or a daemon that hangs.
_LATE_S = 2.0
_BESIDE_THE_AXIS = "a loop whose daemon hangs stops the axis by itself; IF IT MOVES ON, USE THE EMERGENCY STOP"
#: More than any line has; a table takes what it needs.
_PIPE_COLUMNS = 10_000
#: One entry for each document that this command printed.
_printed: list[bool] = []
#: The line of `suggest`.
_suggested: list[str] = []
#: Folders that this command made for its results, outermost first.
_made: list[Path] = []
#: Descriptors of locked folders; they end with the command.
_locks: list[int] = []
#: The environment variable that tells a stage of a command which descriptors these are.
_HANDED_DOWN = "SERVOCTL_LOCKED_FOLDERS"


def keep_inputs(out: Path, *inputs: Path | None) -> None:
    """Raise BadInput where writing `out` would replace a file that is read."""
    for given in inputs:
        if given is not None and same_file(out, given):
            raise BadInput(f"--out {out}", "a file that is read", "another file: nothing is overwritten by itself")


def same_file(one: Path, other: Path) -> bool:
    """Whether both are there, and one file."""
    try:
        return one.samefile(other)
    except OSError:
        return False


def need_folder(option: str, folder: Path, alone: bool = False) -> None:
    """Make `folder` where it is missing, and see that a file can be written in it. Raises BadInput.

    `alone`: no other command that wants it alone works there as long as this process lives. Raises Unreachable.
    """
    try:
        _made.extend(reversed([path for path in (folder, *folder.parents) if not path.exists()]))
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise _no_folder(option, folder, error) from None
    if alone:
        _lock(option, folder)


def _no_folder(option: str, folder: Path, error: OSError) -> BadFile:
    wanted = "a folder that can be written"
    if isinstance(error, FileExistsError | NotADirectoryError):
        return BadFile(f"{option} {folder}", "a file stands where a folder is needed", wanted)
    return BadFile(f"{option} {folder}", f"no file can be written in this folder ({reason(error)})", wanted)


def _lock(option: str, folder: Path) -> None:
    """Lock the folder for as long as this command lives. A stage has its command's lock."""
    if sys.platform == "win32" and is_stage():
        return  # descriptors are not handed on there; the command that waits for this stage holds the lock
    held = _handed_down(folder)
    try:
        _locks.append(lock_folder(folder) if held is None else lock_again(held))
    except OSError:
        raise Unreachable(f"{option} {folder}: another command is at work there; name a folder of its own") from None


def run_stage(arguments: Sequence[str], *, capture: bool = False) -> tuple[int, bytes]:
    """Run `servoctl` with `arguments` as a stage of this command, in a process of its own.

    Returns its exit code, and with `capture` what it printed on standard output.

    The stage works in the folders that this command has locked: it gets their descriptors, and a lock belongs to the
    open file, not to the process.
    """
    import subprocess

    environment = os.environ | {_HANDED_DOWN: " ".join(str(descriptor) for descriptor in _locks)}
    command = [sys.executable, "-m", "servod.cli", *arguments]
    handed = () if sys.platform == "win32" else _locks
    out = subprocess.PIPE if capture else None
    done = subprocess.run(command, pass_fds=handed, env=environment, stdout=out, check=False)
    return done.returncode, done.stdout or b""


def is_stage() -> bool:
    """Whether this command is a stage of another one."""
    return _HANDED_DOWN in os.environ


def _handed_down(folder: Path) -> int | None:
    """The descriptor of `folder` that the command handed to this stage, if it did."""
    wanted = folder.stat()
    for text in os.environ.get(_HANDED_DOWN, "").split():
        with contextlib.suppress(OSError, ValueError):  # not handed on to what a stage starts
            if os.path.samestat(os.fstat(int(text)), wanted):
                return int(text)
    return None


def drop_empty_folders() -> None:
    """At the end of a command: folders that it made and that nothing came into, as it was refused, go again."""
    while _locks:
        os.close(_locks.pop())
    while _made:
        with contextlib.suppress(OSError):  # not empty
            _made.pop().rmdir()


def need_file(option: str, file: Path) -> None:
    """See that `file` can be written before any work is done for it. Raises BadInput."""
    try:
        if stat.S_ISDIR(file.stat().st_mode):
            raise BadFile(f"{option} {file}", "is a folder, a file is needed", "a file that can be written")
    except FileNotFoundError:
        pass
    except OSError as error:
        raise unwritable(f"{option} {file}", error) from None
    need_folder(option, file.absolute().parent)


def table_console(markup: bool = True) -> Console:
    """Where tables are printed: as wide as the terminal, and in a pipe so wide that nothing is cut or broken off."""
    from rich.console import Console

    console = Console(markup=markup, highlight=markup)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _PIPE_COLUMNS
    return console


def one_thread() -> None:
    """Keep linear algebra to one thread, before numpy is imported: threads on small matrices cost a factor of ten."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def example(text: str, *lines: str) -> str:
    """Help text of a command with its examples, each on a line of its own."""
    return text + "\n\nExample:\n\n\b\n" + "\n".join(f"  {line}" for line in lines)


def report(result: dict[str, Any], done: str, as_json: bool) -> None:
    """Print what a commanding verb returned: the result as JSON, or the one word that says what was done."""
    if as_json:
        print_json(result)
    else:
        print(done)


# --- Progress --------------------------------------------------------------------------------------------------------
# One progress bar over a whole command, on standard error, so that standard output stays what was asked for.


@contextmanager
def progress(name: str, quiet: bool) -> Iterator[OnProgress]:
    """A bar that says what is being done; nothing when quiet."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:28}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=quiet, transient=True) as bars:
        task = bars.add_task(name, total=1.0)
        yield lambda what, share: bars.update(task, description=what, completed=share)
