"""What the pages for people say of faults, scenarios and measured figures exists where they say it stands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import readme
import source

from servod.common.faults import FaultCode
from servod.qualify.faults.variants import variants
from servod.runtime.loop.wiring.findings import WiringOutcome

SCENARIOS = source.ROOT / "servod/qualify/faults/scenarios"
RESULTS, SAFETY = readme.DOCS / "results.md", readme.DOCS / "safety.md"
SYMPTOMS = sorted((readme.DOCS / "how-to/symptoms").glob("*.md"))
CODE = re.compile(r"`([A-Z]+(?:_[A-Z]+)*)`")


def rows(text: str) -> Iterator[list[str]]:
    """The cells of each row of each table, without the headings."""
    for line in text.splitlines():
        if line.startswith("| ") and not set(line) <= set("|- "):
            yield [cell.strip() for cell in line.strip("|").split(" | ")]


def test_every_failure_mode_has_a_scenario_or_test_behind_it() -> None:
    names = {name for file in SCENARIOS.rglob("*.yaml") for name, _, _ in variants(file)}
    part = SAFETY.read_text().split("## Failure modes and effects\n")[1].split("\n## ")[0]
    table = [row for row in rows(part) if row[0] != "Part"]
    assert len(table) > 40
    for row in table:
        behind = re.findall(r"`([^`]+)`", row[-1])
        assert behind, row
        for name in behind:
            assert any(fnmatchcase(known, name) for known in names) or (source.ROOT / name).is_file(), name


def test_the_figures_of_the_results_are_quoted_from_the_page_beside_them() -> None:
    quoted, page = 0, RESULTS
    for row in rows(RESULTS.read_text()):
        linked = page_link(row)
        page = RESULTS.parent / linked if linked else page
        for figure in re.findall(r"\*\*([^*]+)\*\*", row[1]):
            assert figure in page.read_text(), f"{figure}: not in {page}"
            quoted += 1
    assert quoted > 20


def page_link(row: list[str]) -> str | None:
    """The page that a row of the results links; none where it says that it is the one above."""
    found = re.search(r"\]\(([^)#]+)", row[2])
    return found and found[1]


def test_every_code_on_a_page_of_symptoms_is_in_a_table() -> None:
    known = {code.name for code in FaultCode} | {outcome.name for outcome in WiringOutcome}
    named = {(file.name, code) for file in [*SYMPTOMS, SAFETY] for code in CODE.findall(file.read_text())}
    others = {"FAULT", "ENABLED", "DISABLED", "STO"}
    assert named and {(file, code) for file, code in named if code not in known | others} == set()


def test_every_page_of_symptoms_names_its_faults_and_links_their_table() -> None:
    for file in SYMPTOMS:
        assert "](../../reference/faults.md)" in file.read_text(), file


def test_one_scenario_has_the_same_figures_on_every_page() -> None:
    """A reader who finds two figures for one event believes neither."""
    dies, fmea = SAFETY.read_text().split("## Failure modes and effects\n")
    figures: dict[str, set[str]] = {}
    for row in rows(dies.split("## What stops the axis when which part dies\n")[1].split("\n## ")[0]):
        if (named := re.search(r"--only '?([\w/]+)", row[-1])) and row[2]:
            figures.setdefault(named[1], set()).add(row[2] if row[2] == row[3] else f"{row[2]} / {row[3]}")
    assert len(figures) > 7
    for row in rows(fmea.split("\n## ")[0]):
        for name in set(re.findall(r"`([^`]+)`", row[-1])) & figures.keys():
            figures[name].add(row[5])
    assert {name: told for name, told in figures.items() if len(told) > 1} == {}
    for row in rows((readme.DOCS / "index.md").read_text()):
        if (named := re.search(r"--only '([\w/]+)'", row[-1])) is not None:
            assert figures.pop(named[1]) == {f"{row[1]} / {row[2]}"}
    drive = " ".join((readme.DOCS / "tutorials/first-drive.md").read_text().split())
    assert "killed/both" not in figures and "after 135 ms, and its torque was gone after 147 ms" in drive


#: Words of the project's own that a drive engineer does not bring along, and the part of the glossary that has each.
OWN_WORDS = {
    "the-machine-and-the-bus": ("quirk", "plant"),
    "the-loop": ("wiring test", "supervisor", "law", "stopping", "guard"),
    "model-gains-certificate": ("gain set", "certified", "certificate", "presliding", "axis model", "map", "recording"),
    "diagnosis-and-trials": (
        *("effect", "mismatch", "explainable", "held-out", "recalibrated", "confidence", "finding", "blind trial"),
    ),
}


class Use(NamedTuple):
    """The first use of a word on a page, and the part of the glossary that has it."""

    word: str
    start: int
    end: int
    part: str


def unlinked(page: Path) -> list[Use]:
    """Words of the project's whose first use in the prose of a page does not lead to the glossary."""

    def blank(found: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", found[0])

    text = page.read_text()
    for other in (r"^```.*?^```$", r"<!--.*?-->", r"^#.*?$", r"`[^`\n]*`", r"!?\[[^\]]*\]\((?!\.\./glossary)[^)]*\)"):
        text = re.sub(other, blank, text, flags=re.DOTALL | re.MULTILINE)
    uses = []
    for part, words in OWN_WORDS.items():
        for word in words:
            first = re.search(rf"(?<![\w/-]){word.replace(' ', chr(92) + 's')}s?(?![\w/])", text, re.IGNORECASE)
            if first and not re.match(r"[^\[\]]*\]\(\.\./glossary\.md#", text[first.end() :]):
                uses.append(Use(word, first.start(), first.end(), part))
    return uses


def test_the_first_use_of_a_word_of_our_own_leads_to_the_glossary() -> None:
    glossary = (readme.DOCS / "glossary.md").read_text()
    parts = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", glossary, re.DOTALL | re.MULTILINE))
    for part, words in OWN_WORDS.items():
        entries = next(text for title, text in parts.items() if re.sub(r"\W+", "-", title.lower()) == part)
        for word in words:
            kind = "certificate" if word == "certified" else word
            assert re.search(rf"^\| [^|]*\*\*{kind}\*\*", entries, re.MULTILINE), word
    lessons = [page for page in (readme.DOCS / "tutorials").glob("*.md") if page.name != "README.md"]
    assert len(lessons) == 3
    assert {page.name: unlinked(page) for page in lessons if unlinked(page)} == {}
    assert all("../glossary.md#" in page.read_text() for page in lessons)
