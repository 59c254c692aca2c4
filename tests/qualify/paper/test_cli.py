"""`servoctl qualify paper --quick` as a whole: files, document, tables, and statements that follow the figures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servod.cli.app import run
from servod.qualify.paper import document as writer
from servod.qualify.paper import table
from servod.qualify.paper.results import Row

pytestmark = pytest.mark.timeout(400)  # some 15 s on two quiet cores; a busy machine is no finding


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("paper")
    assert run(["qualify", "paper", "--out", str(out), "--quick", "--json"]) == 0
    return out


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "paper.json").read_text())
    return loaded


def test_the_files_are_whole_and_no_part_is_left(folder: Path, found: dict[str, Any]) -> None:
    assert {p.name for p in folder.iterdir()} == {"paper.json", "paper.md", "paper.html"}
    text = (folder / "paper.md").read_text()
    assert text == writer.markdown(found)
    assert table.numbers(found).markdown() in text and table.quotation(found) in text


def test_the_page_shows_every_figure_with_its_statements(folder: Path, found: dict[str, Any]) -> None:
    page = (folder / "paper.html").read_text()
    assert page.count("<figure ") == len(found["figures"])
    numbers = {figure["number"] for figure in found["figures"]}
    assert {"2", "4", "6", "9", "10", "11, 12", "15", "16", "17", "18"} <= numbers
    assert all(figure["claims"] for figure in found["figures"] if figure["number"] in {"4", "6", "9", "16", "17"})


def test_the_statements_follow_the_figures(found: dict[str, Any]) -> None:
    tracking = found["joints"]["table1_joint"]["tracking"]
    assert set(tracking) == {row.name.lower() for row in Row}
    pd, proposed, other = (tracking[key]["rms_error_mrad"] for key in ("pd", "table1", "table1_other"))
    assert other > pd > 10.0 * proposed
    by_paper = {c["paper"]: c for figure in found["figures"] for c in figure["claims"]}
    assert by_paper["PD alone has large tracking errors"]["agrees"]
    readings = [c for text, c in by_paper.items() if "read as (K_x, K_v, K_z)" in text]
    assert [c["agrees"] for c in readings] == [other <= 0.3781]
    slips = [said for said in found["statements"] if "(18)" in said["paper"]]
    assert len(slips) == 1 and not slips[0]["agrees"]


def test_a_folder_that_cannot_be_written_is_refused_before_anything_runs(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    assert run(["qualify", "paper", "--out", str(taken / "below"), "--quick"]) == 2
