"""Disturbance: an external torque in a time window of one recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.diagnose.effects.effect import Effect
from servod.diagnose.hypothesis import Document, Reported, Term, Unknown
from servod.diagnose.scene import Scene

Array = NDArray[np.float64]

#: Lengths of windows that are tried, s, and windows that are kept.
LENGTHS_S, KEPT = (0.2, 0.5, 1.0, 2.0, 4.0), 2


def windows(mismatch: Array, period_s: float) -> list[tuple[float, int, int]]:
    """(share, first row, last row) of the windows whose constant torque takes most of the mismatch, best first."""
    total = np.concatenate([[0.0], np.cumsum(mismatch)])
    found = []
    for length in LENGTHS_S:
        rows = round(length / period_s)
        if rows < 5 or rows >= len(mismatch) // 2:
            continue
        sums = total[rows:] - total[:-rows]
        best = int(np.argmax(np.abs(sums)))
        found.append((float(sums[best] ** 2 / rows), best, best + rows))
    return sorted(found, reverse=True)


def _write(document: Document, values: Sequence[float]) -> None:
    start, length, torque = values
    group = document.setdefault("disturbance", {}).setdefault("windows", [])
    group.append({"start_s": start, "end_s": start + length, "torque": torque})


def terms(scene: Scene) -> list[Term]:
    """The windows of all recordings in which a constant torque takes most; several recordings need different times."""
    found = []
    for trace, part in zip(scene.predictor.traces, scene.predictor.slices, strict=True):
        t_s = trace.drive.t_s
        for taken, first, last in windows(scene.mismatch[part], trace.period_s)[:KEPT]:
            mean = float(np.mean(scene.mismatch[part][first:last]))
            found.append((taken, float(t_s[first]), float(t_s[last] - t_s[first]), mean))
    best = sorted(found, reverse=True)[:KEPT]
    return [_term(scene, start, length, mean) for _, start, length, mean in best]


def _term(scene: Scene, start: float, length: float, torque: float) -> Term:
    most = 50.0 * max(scene.dry, 0.2 * scene.effort)
    unknowns = (
        Unknown("start_s", "s", start, start - 2.0 * length, start + 2.0 * length, 0.05),
        Unknown("length_s", "s", length, 0.02, 4.0 * length),
        Unknown("torque", scene.force, torque, -most, most, scene.dry),
    )

    def tell(_document: Document, values: Sequence[float]) -> list[Reported]:
        found = [Reported("start_s", values[0], "s"), Reported("end_s", values[0] + values[1], "s")]
        return [*found, Reported("torque", values[2], scene.force)]

    return Term("disturbance", "constant", unknowns, _write, tell)


EFFECT = Effect(
    name="disturbance",
    group="disturbance",
    equation="torque += torque*cos(2*pi*frequency_hz*(t - start_s) + phase) from start_s to end_s",
    source="somebody leans on the axis, a cable catches, a tool cuts",
    statement="An external torque acts for a while",
    shows="a mismatch in a window of time of one recording, whatever the motion",
    confused=("torque_offset", "thermal"),
    experiment="the same motion again: what does not come back was a disturbance",
    terms=terms,
)
