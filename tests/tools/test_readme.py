"""What the README and the manual say of the code is what the code says."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import blocks
import pytest
import readme
import source

from servod.cli.app import app
from servod.qualify.demo.axis import CONTROLLERS
from servod.qualify.paper.table import QUANTITIES

MOST_README_LINES = 250
#: A link to a file of the project: no address of the network, no mark within the page.
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)")
TEXT = readme.README.read_text()


def texts() -> Iterator[tuple[str, str]]:
    yield from ((str(f.relative_to(source.ROOT)), f.read_text()) for f in readme.texts())


def test_the_readme_is_a_front_door() -> None:
    assert TEXT.count("\n") <= MOST_README_LINES


def test_the_tables_are_current() -> None:
    """`python tests/tools/readme.py` writes them again."""
    for page, text in readme.written().items():
        assert page.read_text() == text, page


def test_every_table_has_its_page() -> None:
    for name, page in readme.PAGES.items():
        text = page.read_text()
        assert readme.with_section(text, name, "elsewhere") != text
    marked = {
        (name, file)
        for file, text in texts()
        for name in re.findall(r"<!-- (\w+): from the code -->", text)
    }  # fmt: skip
    assert marked == {(name, str(page.relative_to(source.ROOT))) for name, page in readme.PAGES.items()}


def test_the_front_doors_figures_are_those_of_the_measured_page() -> None:
    page = readme.PAGES["demo"].read_text()
    rows = re.findall(r"^\| ([^|]+) \| ([\d.]+) \| ([\d.]+) \|$", TEXT, re.MULTILINE)
    assert len(rows) == len(CONTROLLERS) + 1  # and the certified gain set
    for label, rms, largest in rows:
        assert re.search(rf"^\| {re.escape(label)} \| .* \| {rms} \| {largest} \|", page, re.MULTILINE), label


def test_the_papers_table_has_the_rows_that_are_printed() -> None:
    text = readme.PAGES["paper"].read_text()
    (part,) = re.findall(r"<!-- paper: from the code -->\n(.*?)<!-- paper: end -->", text, re.DOTALL)
    numbers = part.split("\n\n")[0].splitlines()[2:]
    assert tuple(line.split(" | ")[0].removeprefix("| ") for line in numbers) == QUANTITIES


def test_every_servoctl_command_that_is_shown_exists() -> None:
    verbs = {c.name for c in app.registered_commands} | {g.name for g in app.registered_groups}
    shown = {
        (verb, name)
        for name, text in texts()
        for verb in re.findall(r"(?:`|^ *|&& )servoctl ([a-z][a-z-]*)", text, re.M)
    }
    assert shown and {(verb, name) for verb, name in shown if verb not in verbs} == set()


def test_every_file_that_is_named_exists() -> None:
    pattern = re.compile(r"`((?:servod|drivers|gains|systemd|tests|scripts|docs|examples)/[\w./@-]+)`")
    named = {(name, file) for file, text in texts() for name in pattern.findall(text)}
    missing = [(name, file) for name, file in named if "NAME" not in name and not (source.ROOT / name).exists()]
    assert named and missing == []


def test_every_link_leads_to_a_file() -> None:
    linked = [(f.parent / target[0], f) for f in readme.texts() for target in LINK.findall(f.read_text())]
    missing = [f"{f.relative_to(source.ROOT)}: {target}" for target, f in linked if not target.exists()]
    assert linked and missing == []


def test_every_page_can_be_reached() -> None:
    """From the README, link by link."""
    reached, waiting = set(), [readme.README]
    while waiting:
        page = waiting.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        waiting += [(page.parent / target[0]).resolve() for target in LINK.findall(page.read_text())]
    pages = {f for f in readme.texts() if f.name != "CHANGELOG.md"}
    assert {str(f.relative_to(source.ROOT)) for f in pages - reached} == set()


def test_the_two_commands_stand_in_it_and_run_on_their_own() -> None:
    commands = re.findall(r"^(\./\w+)(?: |$)", TEXT, re.MULTILINE)
    assert "./demo" in commands and "./test" in commands
    for name in ("demo", "test"):
        assert (source.ROOT / name).stat().st_mode & 0o111


def test_the_here_document_of_the_first_steps_ends_where_its_word_stands() -> None:
    (word,) = re.findall(r"<<(\w+)$", blocks.first_steps(), re.MULTILINE)
    assert blocks.first_steps().splitlines().count(word) == 1


@pytest.mark.serial
def test_the_first_steps_work_as_they_stand(tmp_path: Path) -> None:
    """Every line between the marks, by a shell that ends at the first error; the commands are those of this Python."""
    told = blocks.run(blocks.first_steps(), tmp_path, 100.0)
    assert told.count("motion done: RMS error ") == 2
    assert "drawn: out/axis/first.html" in told
    assert "open-loop position error" in told
