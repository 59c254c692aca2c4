"""The page of `servoctl demo`: what was run, how well each controller tracked, and the curves.

Behind servod.demo; needs the lab part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servod.demo.entries import Entry
from servod.demo.runs import SETTLE_S, Run
from servod.report.curves import histogram, time_curves
from servod.report.page import Page

Labels = Mapping[str, str]


class Story(NamedTuple):
    """How the runs came about: the plant's name, stepped or on the wall clock, and refused real-time rights."""

    plant: str
    stepped: bool
    refused: Sequence[str] = ()


def write_demo_page(rows: Sequence[Entry], runs: Sequence[Run], path: Path, story: Story) -> None:
    """Write the demo's report to `path`, one run for each row; raises BadInput when that is not possible."""
    page = Page("servod demo: trajectory (19) under four controllers")
    labels = {row.name: row.label for row in rows}
    _say(page, labels, runs, story)
    _compare(page, rows, runs)
    for run in runs:
        _show(page, labels[run.controller], run)
    if not story.stepped:
        _timing(page, labels, runs)
    page.write(path)


def _say(page: Page, labels: Labels, runs: Sequence[Run], story: Story) -> None:
    scores = {labels[run.controller]: run.score().rms_error_mrad for run in runs}
    best, worst = min(scores, key=scores.__getitem__), max(scores, key=scores.__getitem__)
    page.sentence(
        f"A virtual servo axis with a sticking joint ({story.plant}) tracked x = (0.1 - 0.0033 t) sin(0.2 pi t) rad "
        f"for {runs[0].time_s[-1]:.0f} s under each of {len(runs)} controllers, over CAN frames at 1 kHz."
    )
    page.sentence(
        f"{best} tracked best with {scores[best]:.3f} mrad RMS, {worst} worst with {scores[worst]:.3f} mrad. "
        f"Errors are encoder position against reference, without the first {SETTLE_S:.0f} s."
    )
    way = (
        "stepped from SYNC to SYNC in one process, in virtual time"
        if story.stepped
        else "on the wall clock, as two processes"
    )
    page.sentence(
        f"Daemon and virtual axis ran {way}: {sum(run.cycles for run in runs)} cycles, "
        f"{sum(run.missed for run in runs)} of them missed."
    )
    if story.refused:
        page.sentence(f"The system refused the loop real-time rights: {', '.join(story.refused)}.")


def _compare(page: Page, rows: Sequence[Entry], runs: Sequence[Run]) -> None:
    page.sentence(
        "The four controllers have the same PD feedback. What else each law had stands in the table; what a single "
        "option is worth shows when gain sets without it run beside them (servoctl demo --gains FILE)."
    )
    cells = []
    for row, run in zip(rows, runs, strict=True):
        score = run.score()
        cells.append(
            [
                row.label,
                row.options,
                f"{score.rms_error_mrad:.3f}",
                f"{score.max_error_mrad:.3f}",
                f"{run.cycles}",
                f"{run.missed}",
            ]
        )
    page.table(["controller", "options", "RMS error / mrad", "largest error / mrad", "cycles", "missed"], cells)
    page.heading("Tracking errors")
    figure = time_curves(runs[0].time_s, {}, "Reference minus encoder position", "mrad")
    for row, run in zip(rows, runs, strict=True):
        part = time_curves(run.time_s, {row.label: run.error_mrad}, "", "")
        figure.add_traces(part.data)
    page.figure(figure)


def _show(page: Page, label: str, run: Run) -> None:
    rows, time_s = run.rows, run.time_s
    page.heading(label)
    page.figure(
        time_curves(time_s, {"reference": rows["reference_rad"], "encoder": rows["position_rad"]}, "Position", "rad")
    )
    parts = {
        "sent": rows["torque_nm"],
        "feedback": rows["torque_feedback_nm"],
        "friction compensation": rows["torque_friction_nm"],
        "other": rows["torque_other_nm"],
    }
    page.figure(time_curves(time_s, {k: v for k, v in parts.items() if np.any(v)}, "Torque and its parts", "N·m"))


def _timing(page: Page, labels: Labels, runs: Sequence[Run]) -> None:
    page.heading("How the loop kept time")
    lag = {labels[run.controller]: run.rows["lag_ns"] / 1e3 for run in runs}
    page.figure(histogram(lag, "Wake-up after the deadline", "µs"))
    sent = {labels[run.controller]: run.rows["torque_sent_ns"] / 1e3 for run in runs}
    page.figure(histogram(sent, "Deadline to torque frame", "µs"))
