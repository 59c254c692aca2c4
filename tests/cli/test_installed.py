"""Who misses a package is told the command that fits how servod was installed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from servod.cli.app import command_for, extra_of, run

EDITABLE = {"dir_info": {"editable": True}}


def test_from_a_checkout_with_its_own_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkout = tmp_path / "my servod"
    origin = EDITABLE | {"url": checkout.as_uri()}
    checkout.mkdir()
    install = ".venv/bin/pip install -e '.[lab]'"
    assert command_for("lab", origin, checkout / ".venv") == f"cd '{checkout}' && {install}"
    monkeypatch.chdir(checkout)
    assert command_for("lab", origin, checkout / ".venv") == install
    elsewhere = tmp_path / "env"
    assert command_for("lab", origin, elsewhere) == f"{elsewhere}/bin/pip install -e '.[lab]'"
    monkeypatch.setattr(sys, "platform", "win32")
    assert command_for("lab", origin, checkout / ".venv").startswith(".venv/Scripts/pip install")


@pytest.mark.parametrize(
    ("files", "command"),
    [
        ([], "python -m pip install 'servod[lab]'"),
        (["pipx_metadata.json"], "pipx install --force 'servod[lab]'"),
        (["uv-receipt.toml", "uv = 0.5"], "uv tool install 'servod[lab]'"),
        (["uv = 0.5"], "uv pip install --python {prefix} 'servod[lab]'"),
    ],
    ids=["pip", "pipx", "uv tool", "uv"],
)
def test_from_an_index(files: list[str], command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    (tmp_path / "pyvenv.cfg").write_text("home = /usr/bin\n" + "".join(line for line in files if "=" in line))
    for name in files:
        (tmp_path / name).touch()
    assert command_for("lab", {}, tmp_path) == command.format(prefix=tmp_path)


def test_from_a_wheel_or_a_repository_the_same_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    wheel = {"url": "file:///home/me/servod-0.1.0-py3-none-any.whl", "archive_info": {}}
    assert command_for("lab", wheel, tmp_path) == f"python -m pip install 'servod[lab] @ {wheel['url']}'"
    git = {"url": "https://example.org/servod.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}}
    assert "'servod[dev] @ git+https://example.org/servod.git@abc'" in command_for("dev", git, tmp_path)


def test_another_python_on_the_path_is_not_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other, own = tmp_path / "other" / "python", tmp_path / "env"
    other.parent.mkdir()
    other.touch(0o755)
    monkeypatch.setenv("PATH", str(other.parent))
    assert command_for("lab", {}, own) == f"{own}/bin/python -m pip install 'servod[lab]'"


def test_which_extra_has_a_package() -> None:
    assert (extra_of("pyarrow.csv"), extra_of("cvxpy"), extra_of("hypothesis")) == ("lab", "lab", "dev")
    assert extra_of("pydantic") is None and extra_of("no_such_thing") is None


def test_the_line_and_the_document(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("servod.cli.app.how_to_get", lambda extra: f"get {extra}")
    monkeypatch.setitem(sys.modules, "servod.lab.diagnose.effects", None)
    monkeypatch.setattr("servod.cli.app.extra_of", lambda name: "lab")
    assert run(["explain", "--json"]) == 2
    shown = capsys.readouterr()
    error = json.loads(shown.out)["error"]
    assert error["code"] == "missing_extra"
    assert error["message"].startswith("`servoctl explain --json` needs servod[lab] (")
    assert error["message"].endswith("; to get it: get lab")
    assert shown.err == f"servoctl: {error['message']}\n"
