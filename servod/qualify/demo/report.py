"""The page of `servoctl demo`: what was run, how well each controller tracked, and the curves.

Behind servod.qualify.demo; needs the lab part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.colors import qualitative

from servod.kernels.laws import LABELS
from servod.kernels.scoring import SETTLE_S
from servod.lab.report.figure import histogram, time_curves
from servod.lab.report.page import Page
from servod.qualify.demo.axis import CONTROLLERS
from servod.qualify.demo.entries import DemoRow
from servod.qualify.demo.runs import Run

Labels = Mapping[str, str]

#: Errors below this share of the worst cannot be told apart beside it; they get a picture of their own.
_FINE = 0.1

#: What the legend of the torque figures means.
_PARTS = (
    "The torque sent to the drive is the sum of three parts, after the limits: PD feedback, from the tracking error; "
    "friction model, what the law's own model of friction asks for; observer and feed-forward, the estimate of a "
    "disturbance observer, which is where PD + DOB compensates friction, and the inertia's part of the reference. A "
    "part that a law does not have is not drawn."
)


class Story(NamedTuple):
    """How the runs came about: the plant's name, stepped or on the wall clock, and refused real-time rights."""

    plant: str
    stepped: bool
    refused: Sequence[str] = ()


def write_demo_page(rows: Sequence[DemoRow], runs: Sequence[Run], path: Path, story: Story) -> None:
    """Write the demo's report to `path`, one run for each row; raises BadInput when that is not possible."""
    page = Page(f"servod demo: trajectory (19) under {len(rows)} controllers")
    labels = {row.name: row.label for row in rows}
    _say(page, labels, runs, story)
    _compare(page, rows, runs)
    _show_errors(page, rows, runs)
    page.heading("Positions and torques")
    page.sentence(_PARTS)
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


def _compare(page: Page, rows: Sequence[DemoRow], runs: Sequence[Run]) -> None:
    alike = [LABELS[name] for name in CONTROLLERS]
    page.sentence(
        f"{', '.join(alike[:-1])} and {alike[-1]} have the same PD feedback. What else each law had "
        "stands in the table; what a single option is worth shows when gain sets without it run beside them "
        "(servoctl demo --gains FILE)."
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
    for row in rows:
        if row.margins:
            page.sentence(f"{row.label}: {row.margins}.")
    page.table(["controller", "options", "RMS error / mrad", "largest error / mrad", "cycles", "missed"], cells)


def _show_errors(page: Page, rows: Sequence[DemoRow], runs: Sequence[Run]) -> None:
    """All errors on one scale, and then the small ones on theirs; a controller keeps its colour."""
    page.heading("Tracking errors")
    shown = list(zip(rows, runs, strict=True))
    colours = dict(zip((row.name for row in rows), cycle(qualitative.Plotly), strict=False))
    page.figure(_errors(shown, "Reference minus encoder position", colours))
    limit_mrad = _FINE * max(run.score().rms_error_mrad for run in runs)
    fine = [(row, run) for row, run in shown if run.score().rms_error_mrad < limit_mrad]
    if fine:
        page.sentence("Large errors hide the small ones; here those below a tenth of the worst stand by themselves.")
        left_out = " and ".join(row.label for row, run in shown if run.score().rms_error_mrad >= limit_mrad)
        page.figure(_errors(fine, f"The same without {left_out}", colours))


def _errors(shown: Sequence[tuple[DemoRow, Run]], title: str, colours: Mapping[str, str]) -> go.Figure:
    figure = time_curves(shown[0][1].time_s, {}, title, "mrad")
    for row, run in shown:
        figure.add_traces(time_curves(run.time_s, {row.label: run.error_mrad}, "", "").data)
        figure.data[-1].line.color = colours[row.name]
    # The first second is not scored; it may leave the picture, so that it does not set the scale.
    scored = [run.error_mrad[run.time_s >= SETTLE_S] for _, run in shown]
    reach = 1.1 * max(float(abs(error).max(initial=0.0)) for error in scored)
    figure.update_yaxes(range=[-reach, reach] if reach > 0.0 else None)
    return figure


def _show(page: Page, label: str, run: Run) -> None:
    rows, time_s = run.rows, run.time_s
    page.heading(label)
    page.figure(
        time_curves(time_s, {"reference": rows["reference_rad"], "encoder": rows["position_rad"]}, "Position", "rad")
    )
    parts = {
        "sent to the drive": rows["torque_nm"],
        "PD feedback": rows["torque_feedback_nm"],
        "friction model": rows["torque_friction_nm"],
        "observer and feed-forward": rows["torque_other_nm"],
    }
    page.figure(time_curves(time_s, {k: v for k, v in parts.items() if np.any(v)}, "Torque and its parts", "N·m"))


def _timing(page: Page, labels: Labels, runs: Sequence[Run]) -> None:
    page.heading("How the loop kept time")
    lag = {labels[run.controller]: run.rows["lag_ns"] / 1e3 for run in runs}
    page.figure(histogram(lag, "Wake-up after the deadline", "µs"))
    sent = {labels[run.controller]: run.rows["torque_sent_ns"] / 1e3 for run in runs}
    page.figure(histogram(sent, "Deadline to torque frame", "µs"))
