"""How a command ends that does not do what it was asked: one line on standard error, one document under `--json`.

The document is `{"error": {"code", "exit_code", "message", "where", "found", "allowed"}}`,
the last three null where they are not known. A command whose answer is "no" and that has printed its own document
already prints no second one.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

from servod.cli.common import json_is_printed, print_json
from servod.client.control import Refused
from servod.common.errors import AnswerIsNo, BadInput, Details, ServodError, Unreachable, details, one_line
from servod.common.files import BadFile

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
        known = _details(error, arguments)._asdict()
        print_json({"error": {"code": code, "exit_code": exit_code, "message": message, **known}})
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
