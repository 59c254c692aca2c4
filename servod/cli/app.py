"""`servoctl`: the command line for commissioning. One file per verb; each imports what it needs only when it runs.

Stands above everything else and holds nothing that acts by itself: it talks to the daemon over its control socket, or
works on files alone. Exit codes are those of servod.common.errors: 0 done, 1 the answer is no, 2 bad input, 3
unreachable. What ends otherwise than it was asked to says so in one place, below.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import re
import shlex
import shutil
import sys
from functools import cache
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer
from typer.main import get_command

from servod import __version__
from servod.cli.common import begin_command, drop_empty_folders, is_stage, json_is_printed, print_json, say_next
from servod.cli.groups import NEXT, Grouped, modules
from servod.client.control import Refused
from servod.common.errors import AnswerIsNo, BadInput, Details, ServodError, Unreachable, details, one_line
from servod.common.files import BadFile, unwritable

#: Windows says EINVAL of a pipe whose reader has gone.
_GONE = {errno.EPIPE, errno.EINVAL} if sys.platform == "win32" else {errno.EPIPE}
_INSTALL_COMPLETION = "--install-completion"
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
        if isinstance(error, OSError) and _INSTALL_COMPLETION in arguments:  # typer's, which writes to the home
            error = unwritable(error.filename or Path.home(), error)
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


# --- Errors ----------------------------------------------------------------------------------------------------------
# How a command ends that does not do what it was asked: one line on standard error, one document under `--json`.
#
# The document is `{"error": {"code", "exit_code", "message", "where", "found", "allowed"}}`, the last three null
# where they are not known. A command whose answer is "no" and that has printed its own document already prints no
# second one.


# How this servod came onto the machine, and by which command it gets the packages of an extra: an advice that fits pip
# alone would put them elsewhere than where servoctl looks. What it asks is imported only when a package is missing.
_DISTRIBUTION = "servod"


def extra_of(package: str) -> str | None:
    """The extra that installs an import package, as servod's own metadata says; None when none does."""
    from importlib import metadata

    name = re.escape(package.partition(".")[0])
    try:
        lines = metadata.requires(_DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return None
    found = [re.match(rf"{name}\b.*\bextra == ['\"]([\w-]+)['\"]", line) for line in lines]
    return next((match[1] for match in found if match), None)


def how_to_get(extra: str) -> str:
    """The command that adds `extra` to this installation."""
    from importlib import metadata

    try:
        origin = metadata.distribution(_DISTRIBUTION).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        origin = None
    return command_for(extra, json.loads(origin) if origin else {}, Path(sys.prefix))


def command_for(extra: str, origin: dict[str, Any], prefix: Path) -> str:
    """The same for the environment at `prefix`; `origin` is direct_url.json (PEP 610), empty for a package index."""
    from urllib.parse import unquote, urlsplit
    from urllib.request import url2pathname

    if origin.get("dir_info", {}).get("editable"):
        return _in_checkout(extra, Path(url2pathname(unquote(urlsplit(origin["url"]).path))), prefix)
    wanted = f"'{_requirement(extra, origin)}'"
    if (prefix / "pipx_metadata.json").exists():
        return f"pipx install --force {wanted}"
    if (prefix / "uv-receipt.toml").exists():
        return f"uv tool install {wanted}"
    if _made_by_uv(prefix):
        return f"uv pip install --python {_quoted(prefix)} {wanted}"
    return f"{_python(prefix)} -m pip install {wanted}"


def _in_checkout(extra: str, checkout: Path, prefix: Path) -> str:
    """From within the checkout, by its own environment's pip where that is the one."""
    if _made_by_uv(prefix):
        install = f"uv pip install --python {_quoted(_shortest(prefix, checkout))}"
    else:
        install = f"{_quoted(_shortest(prefix / _scripts() / 'pip', checkout))} install"
    here = "" if checkout == Path.cwd() else f"cd {_quoted(checkout)} && "
    return f"{here}{install} -e '.[{extra}]'"


def _requirement(extra: str, origin: dict[str, Any]) -> str:
    """servod with its extra, from where this one came (PEP 508)."""
    if "url" not in origin:
        return f"{_DISTRIBUTION}[{extra}]"
    vcs = origin.get("vcs_info")
    url = f"{vcs['vcs']}+{origin['url']}@{vcs['commit_id']}" if vcs else origin["url"]
    return f"{_DISTRIBUTION}[{extra}] @ {url}"


def _made_by_uv(prefix: Path) -> bool:
    """Whether uv made this environment, which has no pip of its own then."""
    try:
        return re.search(r"^uv\s*=", (prefix / "pyvenv.cfg").read_text(encoding="utf-8"), re.MULTILINE) is not None
    except OSError:
        return False


def _python(prefix: Path) -> str:
    """`python` where that is the one of the environment, else its path."""
    own = prefix / _scripts() / "python"
    found = shutil.which("python")
    return "python" if found is None or Path(found).parent == own.parent else _quoted(own)


def _scripts() -> str:
    return "Scripts" if sys.platform == "win32" else "bin"


def _shortest(path: Path, checkout: Path) -> Path:
    return path.relative_to(checkout) if path.is_relative_to(checkout) else path


def _quoted(path: Path) -> str:
    text = os.fspath(path)
    return f"'{text}'" if " " in text else text


#: What typer says of a file before we could.
_NOT_READABLE = re.compile(r"path '(.*)' is not readable", re.IGNORECASE)
#: As shells count SIGINT.
INTERRUPTED = 130
#: The `code` of each kind of error, the narrowest first.
_CODES: tuple[tuple[type[BaseException], str], ...] = (
    (BadFile, "bad_file"),
    (BadInput, "bad_input"),
    (Refused, "refused"),
    (Unreachable, "unreachable"),
    (AnswerIsNo, "answer_is_no"),
    (ServodError, "failed"),
    (ImportError, "missing_extra"),
    (typer.TyperException, "usage"),
    (KeyboardInterrupt, "interrupted"),
    (typer.Abort, "interrupted"),
)


def wants_json(arguments: list[str]) -> bool:
    """Whether `--json` is among the options, whatever else is wrong with them."""
    return "--json" in (arguments[: arguments.index("--")] if "--" in arguments else arguments)


def complain(error: BaseException, arguments: list[str]) -> int:
    """Tell the user, and return the exit code; an error that is none of the user's is raised again, with its trace."""
    if isinstance(error, typer.BadParameter) and (unread := _NOT_READABLE.search(error.message)):
        error = BadFile(unread[1], "may not be read (permission denied)", "a file or folder that may be read")
    code = next((code for kind, code in _CODES if isinstance(error, kind)), "internal")
    if isinstance(error, ImportError) and extra_of(error.name or "?") is None:
        code = "internal"
    message, exit_code = _message(error, code, arguments), _exit_code(error)
    if wants_json(arguments) and not json_is_printed():
        known = _details(error, arguments)._asdict()
        print_json({"error": {"code": code, "exit_code": exit_code, "message": message, **known}})
    if code == "internal":
        raise error
    if code != "interrupted" or not is_stage():  # the command of a stage is interrupted with it, and says so
        say(message)
    return exit_code


def say(message: str) -> None:
    """One line on standard error."""
    print(f"servoctl: {' '.join(message.split())}", file=sys.stderr)


def _exit_code(error: BaseException) -> int:
    if isinstance(error, ServodError):
        return error.exit_code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return INTERRUPTED
    return 2 if isinstance(error, ImportError | typer.TyperException) else 1


def _message(error: BaseException, code: str, arguments: list[str]) -> str:
    asked = shlex.join(["servoctl", *arguments])
    if code == "internal":
        return f"{type(error).__name__}: {one_line(error)}"
    if isinstance(error, ImportError):
        extra = extra_of(error.name or "?") or ""
        return f"`{asked}` needs servod[{extra}] ({error.name} is missing); to get it: {how_to_get(extra)}"
    if isinstance(error, typer.TyperException):
        line = _usage_line(error, arguments)
        return one_line(f"{line}{' See' if line.endswith('?') else '; see'} `{_asked_for(error)} --help`")
    return "interrupted" if code == "interrupted" else " ".join(str(error).split())


def _details(error: BaseException, arguments: list[str]) -> Details:
    """What is known of where it stands."""
    return _usage_details(error, arguments) if isinstance(error, typer.TyperException) else details(error)


def _usage_line(error: Any, arguments: list[str]) -> str:
    """What is wrong with the command line, in the words of every other refusal where option and value are known."""
    where, found, allowed = _usage_details(error, arguments)
    if where is not None and allowed is not None:
        return f"{where}: found {'nothing' if found is None else found}; allowed: {allowed}"
    return str(error.format_message()).rstrip(". ")


def _usage_details(error: Any, arguments: list[str]) -> Details:
    """Option or argument, the value that was given for it, and what may stand there."""
    param, where = getattr(error, "param", None), _option(error)
    refused = re.sub(r"^Value error, ", "", str(getattr(error, "message", "") or "")).rstrip(". ")
    if where is None or param is None or not refused:
        return Details(where)
    allowed = re.sub(r"^Input should be |^.* is not (?=one of )|, unable to parse .*$", "", refused)
    return Details(where, _given(param.opts, arguments), allowed)


def _given(options: list[str], arguments: list[str]) -> str | None:
    """The value that stands behind an option on the command line."""
    for word, behind in pairwise([*arguments, ""]):
        name, equals, value = word.partition("=")
        if name in options and name.startswith("-"):
            return one_line(value if equals else behind)
    return None


def _asked_for(error: Any) -> str:
    """The command whose help tells more: "servoctl track paper"."""
    return str(getattr(getattr(error, "ctx", None), "command_path", None) or "servoctl")


def _option(error: Any) -> str | None:
    """The option or argument that a usage error is about."""
    param, name = getattr(error, "param", None), getattr(error, "option_name", None)
    if param is not None:
        return " / ".join(re.findall(r"[\w-]+", param.get_error_hint())) or None
    return str(name) if name else None
