"""What the pages for people say of faults, scenarios and measured figures exists where they say it stands."""

from __future__ import annotations

import re
from collections.abc import Iterator
from fnmatch import fnmatchcase

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
