"""The page of `servoctl demo`: what was run, how well each controller tracked, and the curves.

Behind servod.qualify.demo; needs the lab part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from servod.kernels.laws import LABELS
from servod.kernels.scoring import SETTLE_S
from servod.lab.report.figure import (
    COLOURS,
    Array,
    Colour,
    Figure,
    PageTable,
    PlotAxis,
    PlotPanel,
    ScaleKind,
    Style,
    curve,
)
from servod.lab.report.page import Origin, Page, Verdict
from servod.qualify.demo.axis import CONTROLLERS
from servod.qualify.demo.entries import DemoRow
from servod.qualify.demo.runs import Run

Labels = Mapping[str, str]

#: Errors below this share of the worst cannot be told apart beside it; they get a picture of their own.
_FINE = 0.1
_BINS = 120

#: What the legend of the torque figures means.
_PARTS = (
    "The torque sent to the drive is the sum of three parts, after the limits: PD feedback, from the tracking error; "
    "friction model, what the law's own model of friction asks for; observer and feed-forward, the estimate of a "
    "disturbance observer, which is where PD + DOB compensates friction, and the inertia's part of the reference. A "
    "part that a law does not have is not drawn."
)


class Story(NamedTuple):
    """How the runs came about: the plant's name, stepped or on the wall clock, refused real-time rights, its file."""

    plant: str
    stepped: bool
    refused: Sequence[str] = ()
    file: Path | None = None


def write_demo_page(rows: Sequence[DemoRow], runs: Sequence[Run], path: Path, story: Story) -> None:
    """Write the demo's report to `path`, one run for each row; raises BadInput when that is not possible."""
    scores = {row.label: run.score().rms_error_mrad for row, run in zip(rows, runs, strict=True)}
    page = Page(
        f"servod demo: trajectory (19) under {len(rows)} controllers",
        Verdict(demo_verdict(scores)),
        Origin({"gain sets": [row.gains for row in rows]} | ({"axis model": story.file} if story.file else {})),
    )
    labels = {row.name: row.label for row in rows}
    _say(page, runs, story)
    _compare(page, rows, runs)
    _show_errors(page, rows, runs, scores)
    page.heading("Positions and torques")
    page.sentence(_PARTS)
    for run in runs:
        page.figure(_motion(labels[run.controller], run))
    if not story.stepped:
        _timing(page, labels, runs)
    page.write(path)


def demo_verdict(scores: Mapping[str, float]) -> str:
    """What a newcomer wants to know: the error that friction makes of a plain loop, and what is left of it.

    `scores` are RMS errors in mrad by what people read, that of the plain loop first.
    """
    plain, best = next(iter(scores)), min(scores, key=scores.__getitem__)
    left = f"{plain} leaves {scores[plain]:.3f} mrad RMS of tracking error on a joint that sticks"
    if best == plain:
        return f"{left}, and no other controller less."
    times = scores[plain] / max(scores[best], 1e-12)
    return f"{left}; the least is {scores[best]:.3f} mrad ({best}), {times:.0f} times less."


def _say(page: Page, runs: Sequence[Run], story: Story) -> None:
    page.sentence(
        f"A virtual servo axis with a sticking joint ({story.plant}) tracked x = (0.1 - 0.0033 t) sin(0.2 pi t) rad "
        f"for {runs[0].time_s[-1]:.0f} s under each of {len(runs)} controllers, over CAN frames at 1 kHz. "
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
    cells = []
    for row, run in sorted(zip(rows, runs, strict=True), key=lambda pair: pair[1].score().rms_error_mrad):
        score = run.score()
        errors = (f"{score.rms_error_mrad:.3f}", f"{score.max_error_mrad:.3f}")
        cells.append((row.label, *errors, row.options, f"{run.cycles}", f"{run.missed}"))
    header = ("controller", "RMS error / mrad", "largest error / mrad", "options", "cycles", "missed")
    page.table(PageTable("Errors, the smallest first", header, tuple(cells)))
    alike = [LABELS[name] for name in CONTROLLERS]
    page.sentence(
        f"{', '.join(alike[:-1])} and {alike[-1]} have the same PD feedback. What else each law had "
        "stands in the table; what a single option is worth shows when gain sets without it run beside them "
        "(servoctl demo --gains FILE)."
    )
    for row in rows:
        if row.margins:
            page.sentence(f"{row.label}: {row.margins}.")


def _show_errors(page: Page, rows: Sequence[DemoRow], runs: Sequence[Run], scores: Mapping[str, float]) -> None:
    """All errors on one scale, and then the small ones on theirs; a controller keeps its colour."""
    page.heading("Tracking errors")
    shown = list(zip(rows, runs, strict=True))
    page.figure(_errors("errors", "Reference minus encoder position", shown, shown, scores))
    limit_mrad = _FINE * max(scores.values())
    fine = [(row, run) for row, run in shown if scores[row.label] < limit_mrad]
    if fine:
        page.sentence("Large errors hide the small ones; here those below a tenth of the worst stand by themselves.")
        left_out = " and ".join(row.label for row, _ in shown if scores[row.label] >= limit_mrad)
        page.figure(_errors("small_errors", f"The same without {left_out}", fine, shown, scores))


def _errors(
    name: str,
    title: str,
    shown: Sequence[tuple[DemoRow, Run]],
    every: Sequence[tuple[DemoRow, Run]],
    scores: Mapping[str, float],
) -> Figure:
    indices = {row.name: index for index, (row, _) in enumerate(every)}
    curves = tuple(
        curve(row.label, run.time_s, run.error_mrad, COLOURS[indices[row.name] % len(COLOURS)], width=1.0,
              style=Style.LINE if indices[row.name] < len(COLOURS) else Style.DASHED)
        for row, run in shown
    )  # fmt: skip
    # The first second is not scored; it may leave the picture, so that it does not set the scale.
    scored = [run.error_mrad[run.time_s >= SETTLE_S] for _, run in shown]
    reach = 1.1 * max(float(abs(error).max(initial=0.0)) for error in scored)
    span = (-reach, reach) if reach > 0.0 else None
    rms = ", ".join(f"{row.label} {scores[row.label]:.3f} mrad" for row, _ in shown)
    panel = PlotPanel(_over_time([run for _, run in shown]), PlotAxis("error in mrad", span=span), curves)
    return Figure(name, title, (panel,), caption=f"RMS from {SETTLE_S:g} s on: {rms}.", row_height=1.4)


def _over_time(runs: Sequence[Run]) -> PlotAxis:
    return PlotAxis("time in s", span=(0.0, max(float(run.time_s[-1]) for run in runs)))


def _motion(label: str, run: Run) -> Figure:
    """Position, and torque with its parts, of one run."""
    rows, t = run.rows, run.time_s
    position = (
        curve("reference", t, 1e3 * rows["reference_rad"], Colour.GREY, Style.DASHED),
        curve("encoder", t, 1e3 * rows["position_rad"]),
    )
    parts = {
        "sent to the drive": (rows["torque_nm"], Colour.BLACK),
        "PD feedback": (rows["torque_feedback_nm"], Colour.BLUE),
        "friction model": (rows["torque_friction_nm"], Colour.ORANGE),
        "observer and feed-forward": (rows["torque_other_nm"], Colour.GREEN),
    }
    torque = tuple(curve(name, t, 1e3 * v, colour, width=1.0) for name, (v, colour) in parts.items() if np.any(v))
    x = _over_time([run])
    panels = (PlotPanel(x, PlotAxis("position in mrad"), position), PlotPanel(x, PlotAxis("torque in mN·m"), torque))
    return Figure(f"motion_{run.controller}", label, panels)


def _timing(page: Page, labels: Labels, runs: Sequence[Run]) -> None:
    page.heading("How the loop kept time")
    for name, column, title in (
        ("lag", "lag_ns", "Wake-up after the deadline"), ("sent", "torque_sent_ns", "Deadline to torque frame"),
    ):  # fmt: skip
        page.figure(_histogram(name, title, {labels[run.controller]: run.rows[column] / 1e3 for run in runs}))


def _histogram(name: str, title: str, samples: Mapping[str, Array]) -> Figure:
    """Distributions over each other, up to the 99.9th percentile; on a logarithmic scale rare ones show."""
    top = max(float(np.percentile(values, 99.9)) for values in samples.values())
    edges = np.linspace(0.0, max(top, 1.0), _BINS + 1)
    curves = tuple(
        curve(label, np.repeat(edges, 2)[1:-1], np.repeat(np.maximum(np.histogram(values, edges)[0], 0.5), 2), colour)
        for (label, values), colour in zip(samples.items(), cycle(COLOURS), strict=False)
    )
    panel = PlotPanel(PlotAxis("time in µs"), PlotAxis("cycles", ScaleKind.LOG), curves)
    return Figure(name, title, (panel,), caption=f"Bins of {edges[1]:.3g} µs; a bin without a cycle is drawn at 0.5.")
