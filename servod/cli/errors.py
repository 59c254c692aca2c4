"""How a command ends that does not do what it was asked: one line on standard error, one document under `--json`.

The document is `{"error": {"code": ..., "exit_code": ..., "message": ..., "where": ..., "found": ..., "allowed": ...}}`
with the last three where they are known. A command whose answer is "no" and that has printed its own document already
prints no second one.
"""

from __future__ import annotations

import re
import shlex
import sys
from typing import Any

import typer

from servod.cli.common import json_is_printed, print_json
from servod.cli.installed import extra_of, how_to_get
from servod.client.control import Refused
from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable, one_line
from servod.common.files import BadFile

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
    code = next((code for kind, code in _CODES if isinstance(error, kind)), "internal")
    if isinstance(error, ImportError) and extra_of(error.name or "?") is None:
        code = "internal"
    message, exit_code = _message(error, code, arguments), _exit_code(error)
    if wants_json(arguments) and not json_is_printed():
        print_json({"error": {"code": code, "exit_code": exit_code, "message": message, **_details(error)}})
    if code == "internal":
        raise error
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
    command = shlex.join(["servoctl", *arguments])
    if code == "internal":
        return f"{type(error).__name__}: {one_line(error)}"
    if isinstance(error, ImportError):
        extra = extra_of(error.name or "?") or ""
        return f"`{command}` needs servod[{extra}] ({error.name} is missing); to get it: {how_to_get(extra)}"
    if isinstance(error, typer.TyperException):
        return " ".join(f"{error.format_message()} Found: `{command}`; see --help.".split())
    return "interrupted" if code == "interrupted" else " ".join(str(error).split())


def _details(error: BaseException) -> dict[str, str]:
    """What is known of where it stands."""
    if isinstance(error, BadInput):
        known = {"where": error.where, "found": error.found, "allowed": error.allowed}
    elif isinstance(error, typer.TyperException):
        known = {"where": _option(error)}
    else:
        known = {}
    return {key: one_line(value) for key, value in known.items() if value not in (None, "")}


def _option(error: Any) -> str | None:
    """The option or argument that a usage error is about."""
    param, name = getattr(error, "param", None), getattr(error, "option_name", None)
    if param is not None:
        return " / ".join(re.findall(r"[\w-]+", param.get_error_hint())) or None
    return str(name) if name else None
