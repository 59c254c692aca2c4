"""Offset drift: the constant torque beside the command changes slowly, alike in both directions of motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.effects import OffsetDrift
from servod.lab.diagnose.effects.effect import Effect
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, Unknown
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

Array = NDArray[np.float64]

#: Shortest recording in which something slow can be told from something short, s.
SHORTEST_S = 4.0

#: Time constants of a drift that ends, as shares of the longest recording: first guess, shortest, longest. A shorter
#: one is over before it is a drift, a longer one is a straight line.
FIRST, LEAST, MOST = 0.4, 0.15, 1.5


def terms(scene: SearchContext) -> list[Term]:
    """A straight line over the time of each recording, and a drift that ends."""
    if scene.duration_s < SHORTEST_S:
        return []
    return [_straight(scene), _ending(scene)]


def _since_start(scene: SearchContext) -> Array:
    """Time of each row since the first row of its recording, s."""
    parts = scene.predictor.slices
    return np.concatenate([scene.time_s[part] - scene.time_s[part.start] for part in parts])


def _size(scene: SearchContext, shape: Array) -> float:
    """What the mismatch has of a torque of this shape over time, beside a constant one."""
    found, _ = scene.fitted([shape, np.ones_like(shape)])
    return float(found[0])


def _straight(scene: SearchContext) -> Term:
    length = scene.duration_s
    change = _size(scene, _since_start(scene) / length)
    most = 20.0 * max(scene.dry, scene.effort)
    unknown = Unknown("change", scene.force, change, -most, most, scene.dry)

    def write(document: Document, values: Sequence[float]) -> None:
        document["offset_drift"] = {"per_s": values[0] / length}

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        return [Reported("per_s", values[0] / length, f"{scene.force}/s")]

    return Term("offset_drift", "straight", (unknown,), write, report)


def _ending(scene: SearchContext) -> Term:
    length = scene.duration_s
    first = FIRST * length
    change = _size(scene, 1.0 - np.exp(-_since_start(scene) / first))
    most = 20.0 * max(scene.dry, scene.effort)
    unknowns = (
        Unknown("change", scene.force, change, -most, most, scene.dry),
        Unknown("time_s", "s", first, LEAST * length, MOST * length),
    )

    def write(document: Document, values: Sequence[float]) -> None:
        document["offset_drift"] = {"per_s": values[0] / values[1], "time_s": values[1]}

    def report(_document: Document, values: Sequence[float]) -> list[Reported]:
        per_s = Reported("per_s", values[0] / values[1], f"{scene.force}/s")
        return [per_s, Reported("time_s", values[1], "s")]

    return Term("offset_drift", "ending", unknowns, write, report)


EFFECT = Effect(
    name="offset_drift",
    group=OffsetDrift,
    equation="torque = command + torque_offset + per_s*t, or per_s*time_s*(1 - exp(-t/time_s)); t from the first row",
    source="offset of a current sensor or amplifier that warms up; a counterbalance that leaks, a cable that settles",
    statement="The constant torque beside the command drifts as time passes",
    shows="a mismatch that grows slowly over each recording, alike in both directions",
    confused=("torque_offset", "disturbance", "thermal"),
    experiment="the same motion for some minutes: a drift goes on or ends, and begins again after power-on",
    terms=terms,
    look=Look("time"),
)
