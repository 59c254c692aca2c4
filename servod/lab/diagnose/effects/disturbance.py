"""Disturbance: an external torque in a window of time, of one recording or after the start of every one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.effects import Disturbance
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

Array = NDArray[np.float64]

#: Windows begin and end on this grid, s, take this share of their recording at most, and so many are kept.
GRID_S, LONGEST, KEPT = 0.05, 0.5, 2

#: A shorter push is a blow that any mass behind a gap or spring can make, or a contact that has aged at rest, s.
SHORTEST_S = 0.3

#: The effect, and the form of a window that comes at the same time after the start of every recording.
NAME, EVERY = "disturbance", "in every recording"


def windows(mismatch: Array, period_s: float) -> list[tuple[float, int, int]]:
    """(power taken, first row, last row) of the windows whose constant torque takes most, best first, none in another.

    Every begin and every end of a grid is looked at: a window half as long again leaves the fit in a narrow valley.
    """
    step = max(round(GRID_S / period_s), 1)
    total = np.concatenate([[0.0], np.cumsum(mismatch)])[::step]
    count = len(total)
    length = np.arange(count)[None, :] - np.arange(count)[:, None]
    allowed = (length * step * period_s >= SHORTEST_S) & (length <= LONGEST * count)
    power = np.where(allowed, (total[None, :] - total[:, None]) ** 2 / np.maximum(length * step, 1), 0.0)
    found: list[tuple[float, int, int]] = []
    while len(found) < KEPT and power.max(initial=0.0) > 0.0:
        first, last = (int(i) for i in np.unravel_index(int(np.argmax(power)), power.shape))
        found.append((float(power[first, last]), first * step, last * step - 1))
        power[:last, first + 1 :] = 0.0
    return found


def terms(scene: SearchContext) -> list[Term]:
    """The windows of single recordings in which a constant torque takes most, and windows common to all of them."""
    found = []
    traces = scene.predictor.traces
    for trace, part in zip(traces, scene.predictor.slices, strict=True):
        for taken, first, last in windows(scene.mismatch[part], trace.period_s):
            mean = float(np.mean(scene.mismatch[part][first:last]))
            found.append((taken, _term(scene, trace.drive.t_s - trace.shift_s, (first, last), mean, (trace.shift_s,))))
    single = [term for _, term in sorted(found, key=lambda pair: -pair[0])[:KEPT]]
    return single + (_common(scene) if len(traces) > 1 else [])


def _common(scene: SearchContext) -> list[Term]:
    """Windows at the same time after the start of every recording."""
    traces, parts = scene.predictor.traces, scene.predictor.slices
    rows = min(part.stop - part.start for part in parts)
    mean = np.mean([scene.mismatch[part][:rows] for part in parts], axis=0)
    t_s = traces[0].drive.t_s - traces[0].shift_s
    shifts = tuple(trace.shift_s for trace in traces)
    best = windows(mean, traces[0].period_s)[:1]
    t_s = t_s[:rows]
    return [_term(scene, t_s, (first, last), float(np.mean(mean[first:last])), shifts) for _, first, last in best]


def _term(scene: SearchContext, t_s: Array, rows: tuple[int, int], torque: float, shifts: tuple[float, ...]) -> Term:
    """A window from row to row of `t_s`, in recordings whose times stand `shifts` later; its shortest lies within."""
    most = 50.0 * max(scene.dry, 0.2 * scene.effort)
    length = max(float(t_s[rows[1]] - t_s[rows[0]]), SHORTEST_S)
    latest = float(t_s[-1]) - SHORTEST_S
    start = min(float(t_s[rows[0]]), latest)
    unknowns = (
        Unknown("start_s", "s", start, start - 2.0 * length, min(start + 2.0 * length, latest), 0.05, nudge=0.05),
        Unknown("length_s", "s", length, SHORTEST_S, 4.0 * length, nudge=0.02),
        Unknown("torque", scene.force, torque, -most, most, scene.dry),
    )

    def write(document: Document, values: Sequence[float]) -> None:
        group = document.setdefault(NAME, {}).setdefault("windows", [])
        for shift in shifts:
            start_s = shift + values[0]
            group.append({"start_s": start_s, "end_s": start_s + values[1], "torque": values[2]})

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        found = [Reported("start_s", values[0], "s"), Reported("end_s", values[0] + values[1], "s")]
        return [*found, Reported("torque", values[2], scene.force)]

    return Term(NAME, EVERY if len(shifts) > 1 else "in one recording", unknowns, write, report)


EFFECT = Effect(
    name=NAME,
    group=Disturbance,
    equation="torque += torque*cos(2*pi*frequency_hz*(t - start_s) + phase) from start_s to end_s",
    source="somebody leans on the axis, a cable catches, a tool cuts",
    statement="An external torque acts for a while",
    shows="a mismatch in a window of time of one recording, whatever the motion",
    confused=("torque_offset", "thermal"),
    experiment="the same motion again: what does not come back was a disturbance",
    terms=terms,
    look=Look("time"),
    repeatable=True,
    soaks_up=True,
)
