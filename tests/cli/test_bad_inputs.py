"""Every bad input of bad_inputs.yaml: exit code 2, one line that names file and key, nothing else."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

import servod.drivers
from servod.cli.app import run
from servod.common.yaml import parse_yaml

TABLE = parse_yaml((Path(__file__).parent / "bad_inputs.yaml").read_text(), "bad_inputs.yaml")
AMPLIFIER_EDS = Path(servod.drivers.__file__).parent / "eds/amplifier.eds"
CASES: list[dict[str, Any]] = TABLE["cases"]


def change(document: dict[str, Any], dotted: str, value: Any) -> None:
    """Set the dotted key, making mappings on the way; `...` removes it."""
    *way, last = dotted.split(".")
    for key in way:
        document = document.setdefault(key, {})
    if value is ...:
        del document[last]
    else:
        document[last] = value


def bad_text(case: dict[str, Any]) -> str:
    """The base file of the case with its one mistake."""
    if "text" in case:
        return case["text"]
    if "replace" in case:
        found, instead = case["replace"]
        text = AMPLIFIER_EDS.read_text()
        assert found in text
        return text.replace(found, instead)
    document = copy.deepcopy(TABLE["bases"][case["file"]])
    for dotted, value in case.get("set", {}).items():
        change(document, dotted, value)
    for dotted in case.get("remove", []):
        change(document, dotted, ...)
    return yaml.safe_dump(document)


def write_files(case: dict[str, Any], folder: Path) -> None:
    """All good base files, and the bad one of the case."""
    for name, document in TABLE["bases"].items():
        (folder / name).write_text(yaml.safe_dump(document))
    if "file" not in case:
        return
    bad = folder / case["file"]
    bad.unlink(missing_ok=True)
    if "bytes" in case:
        bad.write_bytes(bytes.fromhex(case["bytes"]))
    elif not case.get("absent"):
        bad.write_text(bad_text(case))


@pytest.mark.parametrize("case", CASES, ids=[case["name"] for case in CASES])
def test_bad_input_gives_one_line_and_exit_code_2(
    case: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_files(case, tmp_path)
    arguments = case.get("run", ["config", "check", "FILE"])
    code = run([case["file"] if a == "FILE" else a for a in arguments])
    captured = capsys.readouterr()
    assert code == 2, captured
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1, captured.err
    assert "Traceback" not in captured.err
    for word in case["line"]:
        assert word.lower() in captured.err.lower(), captured.err
    assert [entry for entry in tmp_path.rglob("*") if entry.is_dir()] == []


@pytest.mark.parametrize("name", sorted(TABLE["bases"]))
def test_the_base_files_themselves_are_good(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_files({}, tmp_path)
    assert run(["config", "check", name]) == 0, capsys.readouterr()


def test_there_are_at_least_forty_different_mistakes() -> None:
    assert len({case["name"] for case in CASES}) == len(CASES) >= 40
