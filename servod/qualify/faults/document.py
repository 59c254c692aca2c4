"""What the campaign's outcomes say as one document: a row for each scenario, and the worst times of each kind of loss.

Between `campaign` and its readers: terminal, JSON and page.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from servod.lab.report.page import Page
from servod.qualify.faults.run import Outcome
from servod.qualify.faults.scenario import Loss

HEADER = ("Scenario", "Passed", "Ends", "Loss", "Left / ms", "Gone / ms", "Lost", "Recovered", "Injected", "Detected")
_LOSS_TEXT = {Loss.FEEDBACK: "feedback", Loss.MASTER: "master"}


def document(outcomes: Sequence[Outcome], planned: int) -> dict[str, Any]:
    """Everything as plain data; `planned` scenarios were to run."""
    return {
        "planned": planned,
        "run": len(outcomes),
        "files": _files(outcomes),
        "passed": sum(outcome.passed for outcome in outcomes),
        "lost_records": sum(lost_records(outcomes)),
        "recorded": len(lost_records(outcomes)),
        "worst": worst(outcomes),
        "scenarios": [_plain(outcome) for outcome in outcomes],
    }


def worst(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float | None]]:
    """Longest times by kind of loss, in ms of bus time; None where no scenario of the kind ran. Those that are exempt
    from the bound are counted and do not enter the times."""
    table: dict[str, dict[str, float | None]] = {}
    for loss, text in _LOSS_TEXT.items():
        of_kind = [outcome for outcome in outcomes if outcome.loss is loss]
        times = [outcome.reaction for outcome in of_kind if outcome.exempt is None]
        table[text] = {
            "scenarios": len(times),
            "exempt": len(of_kind) - len(times),
            "left_ms": max((t.left_ms for t in times if t.left_ms is not None), default=None),
            "gone_ms": max((t.gone_ms for t in times if t.gone_ms is not None), default=None),
        }
    return table


def cells(outcome: Outcome) -> tuple[str, ...]:
    """One row of the table, under HEADER."""
    return (
        outcome.name,
        "yes" if outcome.passed else "NO",
        outcome.axis,
        ("" if outcome.exempt is None else "exempt: ") + _LOSS_TEXT.get(outcome.loss, "-"),
        milliseconds(outcome.reaction.left_ms),
        milliseconds(outcome.reaction.gone_ms),
        "-" if outcome.lost_records is None else str(outcome.lost_records),
        "yes" if outcome.recovered else "by repair" if outcome.by_repair else "no",
        outcome.injected,
        ", ".join(outcome.detected) or ("refused" if outcome.axis == "DISABLED" and outcome.remedy else "-"),
    )


def text_table(outcomes: Sequence[Outcome]) -> str:
    """The table for a terminal, as wide as it is: nothing of it is cut."""
    rows = [HEADER, *map(cells, outcomes)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def summary(outcomes: Sequence[Outcome], planned: int) -> list[str]:
    """The campaign in a few sentences."""
    passed = sum(outcome.passed for outcome in outcomes)
    lines = [f"{passed} of {len(outcomes)} scenarios in {_files(outcomes)} files passed."]
    if len(outcomes) < planned:
        lines.append(f"{planned - len(outcomes)} of {planned} were not run.")
    for loss, row in worst(outcomes).items():
        if row["scenarios"]:
            lines.append(
                f"Loss of {loss}: {row['scenarios']} scenarios, the drive had left the controller's command after "
                f"{milliseconds(row['left_ms'])} ms and the torque was gone after {milliseconds(row['gone_ms'])} ms "
                "at the latest."
            )
    lines += [f"Exempt from the bound: {o.name}: {o.exempt}." for o in outcomes if o.exempt is not None]
    recovered, repairs = sum(o.recovered for o in outcomes), sum(o.by_repair for o in outcomes)
    lines.append(f"Recovered: {recovered}; {repairs} need repair at the hardware.")
    lost = lost_records(outcomes)
    lines.append(f"Cycle records lost: {sum(lost)} in {len(lost)} scenarios with a recorder.")
    return lines


def lost_records(outcomes: Sequence[Outcome]) -> list[int]:
    """Of each scenario in which a recorder ran."""
    return [outcome.lost_records for outcome in outcomes if outcome.lost_records is not None]


def _files(outcomes: Sequence[Outcome]) -> int:
    """A file may hold several scenarios; theirs are named `file/name`."""
    return len({outcome.name.partition("/")[0] for outcome in outcomes})


def milliseconds(value: float | None) -> str:
    """A time for people; what did not happen is a dash."""
    return "-" if value is None else f"{value:.1f}"


def _plain(outcome: Outcome) -> dict[str, Any]:
    return {
        "name": outcome.name,
        "title": outcome.title,
        "group": outcome.group,
        "loss": outcome.loss.value,
        "exempt": outcome.exempt,
        "injected": outcome.injected,
        "detected": list(outcome.detected),
        "remedy": outcome.remedy,
        "axis": outcome.axis,
        "left_ms": outcome.reaction.left_ms,
        "gone_ms": outcome.reaction.gone_ms,
        "lost_records": outcome.lost_records,
        "recovered": outcome.recovered,
        "passed": outcome.passed,
        "complaints": list(outcome.complaints),
    }


# The page of `servoctl qualify faults`: what was injected, what the drive did, and what the user was told.
#
# Behind the campaign; needs the lab part. All text is escaped by the page.


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
