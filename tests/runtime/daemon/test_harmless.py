"""What others chose (names, paths, texts of devices) is shown and does nothing: in journal, on terminal, on a page."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from servod.cli.scan import _cells
from servod.cli.status import _plain
from servod.common.errors import BadInput
from servod.formats.config import RecorderConfig
from servod.lab.report.figure import Figure, PageTable, PlotAxis, PlotPanel, curve
from servod.lab.report.page import Page, Verdict
from servod.runtime.daemon.main import harmless, print_error, set_up_logging
from servod.runtime.daemon.recorder import RecordingFiles

#: Newlines of every kind, a forged entry, terminal sequences, a text that runs backwards, markup of rich and of HTML.
HOSTILE = (
    "a\nb\r\n<0>forged entry\x1b[2J\x1b]0;title\x07\x9b31m\u2028c\x85d\u202etxt [red]e[/nope] "
    "</title></script><script>alert(1)</script><img src=x onerror=alert(2)>"
)


def acts(text: str) -> list[str]:
    """Characters of a line that are more than their picture."""
    return [c for c in text if not c.isprintable()]


def test_text_is_one_line_of_pictures() -> None:
    assert acts(harmless(HOSTILE)) == []
    assert harmless("grün, 0.5 N·m") == "grün, 0.5 N·m"
    assert "\\x1b[2J" in harmless(HOSTILE)


@pytest.mark.parametrize("in_journal", [True, False])
def test_entry_of_the_log_is_one_whatever_is_in_it(
    in_journal: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if in_journal:
        monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    else:
        monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    kept = logging.getLogger().handlers[:]
    try:
        set_up_logging()
        logging.getLogger("servod").error("node says %s", HOSTILE)
        print_error(HOSTILE)
    finally:
        logging.getLogger().handlers = kept
    lines = capsys.readouterr().err.split("\n")
    assert len(lines) == 3 and lines[2] == ""
    assert [acts(line) for line in lines[:2]] == [[], []]
    assert [line.startswith("<3>") for line in lines[:2]] == [in_journal] * 2


@pytest.mark.parametrize(
    "name", [HOSTILE + ".mcap", "a\n.mcap", "-rf.mcap", ".mcap", "../a.mcap", "a\x1b[2J.mcap", "a.txt", "<b>.mcap"]
)
def test_recordings_have_names_that_do_nothing(tmp_path: Path, name: str) -> None:
    files = RecordingFiles(RecorderConfig(directory=tmp_path), "axis")
    with pytest.raises(BadInput) as refused:
        files.recording(name)
    assert acts(str(refused.value)) == []


@pytest.mark.parametrize("name", ["a.mcap", "Lauf 3 (grün), 0.5.mcap", "2026-11-21_a+b.mcap"])
def test_recordings_may_be_named_as_people_do(tmp_path: Path, name: str) -> None:
    assert RecordingFiles(RecorderConfig(directory=tmp_path), "axis").recording(name).name == name


def shown(*parts: Any, markup: bool) -> str:
    """What a terminal would get."""
    out = io.StringIO()
    Console(file=out, width=1000, markup=markup).print(*parts)
    return out.getvalue()


def test_screens_show_names_and_do_not_obey_them() -> None:
    (text,) = _plain([HOSTILE])
    assert acts(shown(text, markup=True).rstrip("\n")) == []
    assert "[red]e[/nope]" in shown(text, markup=True)
    node = {"node_id": 1, "identity": {"device_type": 402}, "lss": None, "name": HOSTILE}
    name = _cells(node)[-1]
    assert acts(shown(name, markup=False).rstrip("\n")) == []
    assert "[red]e[/nope]" in shown(name, markup=False)


def test_pages_show_markup_as_text() -> None:
    page = Page(HOSTILE, Verdict(HOSTILE))
    page.heading(HOSTILE)
    page.sentence(HOSTILE)
    page.points([HOSTILE])
    page.folded(HOSTILE, [HOSTILE])
    page.table(PageTable(f"{HOSTILE}.", (HOSTILE,), ((HOSTILE,),)))
    text = page.html()
    assert text.count("&lt;script&gt;alert(1)") == 12
    assert "<script>alert" not in text and "<img" not in text


def test_figures_on_a_page_do_not_end_their_script() -> None:
    page, axis = Page("a page", Verdict("drawn")), PlotAxis(HOSTILE, names=(HOSTILE,))
    shown = tuple(curve(label, [0, 1], [0, 1], detail=HOSTILE) for label in (HOSTILE, "b"))
    page.figure(Figure("hostile", HOSTILE, (PlotPanel(axis, axis, shown, HOSTILE),), caption=HOSTILE))
    drawn = page.html().split("</head>")[1]
    assert "<script>alert" not in drawn and "<img" not in drawn
