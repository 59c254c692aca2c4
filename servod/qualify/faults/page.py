"""The page of `servoctl faults`: what was injected, what the drive did, and what the user was told.

Behind the campaign; needs the lab part. All text is escaped by the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from servod.lab.report.page import Page
from servod.qualify.faults.document import HEADER, cells, summary
from servod.qualify.faults.run import Outcome

_TIMES = (
    "Times count from the first injection, in bus time, and come from the virtual drive's own record. Left: the drive "
    "left operation enabled, and with it the controller's command; gone: the joint feels no torque from then on. "
    "Lost: cycles without a record, where a recorder ran. Recovered: the axis was enabled again by what the fault's "
    "remedy says."
)


def write_page(outcomes: Sequence[Outcome], planned: int, path: Path) -> None:
    """Write the page to `path`. Raises BadInput when that is not possible."""
    page = Page("servod: the fault campaign")
    first, *rest = summary(outcomes, planned)
    page.lead(first)
    page.points(rest)
    page.sentence(_TIMES)
    _failures(page, outcomes)
    by_group = sorted(outcomes, key=lambda outcome: (outcome.group, outcome.name))
    for group, members in groupby(by_group, key=lambda outcome: outcome.group):
        rows = list(members)
        page.heading(f"{group.capitalize()}: {len(rows)} scenarios")
        page.table(HEADER, [cells(outcome) for outcome in rows])
        page.folded("What each is, and what the user was told", [_told(outcome) for outcome in rows])
    page.write(path)


def _failures(page: Page, outcomes: Sequence[Outcome]) -> None:
    failed = [outcome for outcome in outcomes if not outcome.passed]
    if failed:
        page.heading("Not as expected")
        page.points([f"{outcome.name}: {'; '.join(outcome.complaints)}" for outcome in failed])


def _told(outcome: Outcome) -> str:
    return f"{outcome.name}: {outcome.title}. {outcome.remedy or 'Nothing was to be told.'}"
