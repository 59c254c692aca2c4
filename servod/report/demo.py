"""The page of `servoctl demo`: what was run, how well each controller tracked, and the curves.

Behind servod.demo; needs the lab part.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servod.demo.axis import LABELS
from servod.demo.runs import SETTLE_S, Run
from servod.report.curves import histogram, time_curves
from servod.report.page import Page


def write_demo_page(runs: Sequence[Run], path: Path, stepped: bool, plant: str) -> None:
    """Write the demo's report to `path`; raises BadInput when that is not possible."""
    page = Page("servod demo: trajectory (19) under four controllers")
    _say(page, runs, stepped, plant)
    _compare(page, runs)
    for run in runs:
        _show(page, run)
    if not stepped:
        _timing(page, runs)
    page.write(path)


def _say(page: Page, runs: Sequence[Run], stepped: bool, plant: str) -> None:
    scores = {LABELS[run.controller]: run.score().rms_error_mrad for run in runs}
    best, worst = min(scores, key=scores.__getitem__), max(scores, key=scores.__getitem__)
    page.sentence(
        f"A virtual servo axis with a sticking joint ({plant}) tracked x = (0.1 - 0.0033 t) sin(0.2 pi t) rad for "
        f"{runs[0].time_s[-1]:.0f} s under each of {len(runs)} controllers, over CAN frames at 1 kHz."
    )
    page.sentence(
        f"{best} tracked best with {scores[best]:.3f} mrad RMS, {worst} worst with {scores[worst]:.3f} mrad. "
        f"Errors are encoder position against reference, without the first {SETTLE_S:.0f} s."
    )
    way = (
        "stepped from SYNC to SYNC in one process, in virtual time"
        if stepped
        else "on the wall clock, as two processes"
    )
    page.sentence(
        f"Daemon and virtual axis ran {way}: {sum(run.cycles for run in runs)} cycles, "
        f"{sum(run.missed for run in runs)} of them missed."
    )


def _compare(page: Page, runs: Sequence[Run]) -> None:
    rows = []
    for run in runs:
        score = run.score()
        rows.append(
            [
                LABELS[run.controller],
                f"{score.rms_error_mrad:.3f}",
                f"{score.max_error_mrad:.3f}",
                f"{run.cycles}",
                f"{run.missed}",
            ]
        )
    page.table(["controller", "RMS error / mrad", "largest error / mrad", "cycles", "missed"], rows)
    page.heading("Tracking errors")
    figure = time_curves(runs[0].time_s, {}, "Reference minus encoder position", "mrad")
    for run in runs:
        part = time_curves(run.time_s, {LABELS[run.controller]: run.error_mrad}, "", "")
        figure.add_traces(part.data)
    page.figure(figure)


def _show(page: Page, run: Run) -> None:
    rows, time_s = run.rows, run.time_s
    page.heading(LABELS[run.controller])
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


def _timing(page: Page, runs: Sequence[Run]) -> None:
    page.heading("How the loop kept time")
    lag = {LABELS[run.controller]: run.rows["lag_ns"] / 1e3 for run in runs}
    page.figure(histogram(lag, "Wake-up after the deadline", "µs"))
    sent = {LABELS[run.controller]: run.rows["torque_sent_ns"] / 1e3 for run in runs}
    page.figure(histogram(sent, "Deadline to torque frame", "µs"))
