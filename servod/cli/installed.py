"""How this servod came onto the machine, and by which command it gets the packages of an extra.

Asked only when a package is missing: an advice that fits pip alone would put them elsewhere than where servoctl looks.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from importlib import metadata
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit
from urllib.request import url2pathname

_DISTRIBUTION = "servod"


def extra_of(package: str) -> str | None:
    """The extra that installs an import package, as servod's own metadata says; None when none does."""
    name = re.escape(package.partition(".")[0])
    try:
        lines = metadata.requires(_DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return None
    found = [re.match(rf"{name}\b.*\bextra == ['\"]([\w-]+)['\"]", line) for line in lines]
    return next((match[1] for match in found if match), None)


def how_to_get(extra: str) -> str:
    """The command that adds `extra` to this installation."""
    try:
        origin = metadata.distribution(_DISTRIBUTION).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        origin = None
    return command_for(extra, json.loads(origin) if origin else {}, Path(sys.prefix))


def command_for(extra: str, origin: dict[str, Any], prefix: Path) -> str:
    """The same for the environment at `prefix`; `origin` is direct_url.json (PEP 610), empty for a package index."""
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
