"""Gravity: a weight off the axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from servod.formats.model.effects import Gravity
from servod.lab.diagnose.effects.effect import Effect, harmonic, share
from servod.lab.diagnose.effects.hypothesis import Document, Reported, Term, get
from servod.lab.diagnose.effects.looks import Look
from servod.lab.diagnose.effects.search_context import SearchContext

#: Way from which on a weight on a linkage may be told from one on an arm, rad: half a turn, a wave of twice its order.
HALF_TURN = math.pi

#: Waves in a turn of what a linkage adds, and the most that its sine and its cosine are of the weight's: where there is
#: more of it, it is not the weight that repeats.
SECOND, MOST_OF_WEIGHT = 2.0, 0.5


def _add(document: Document, values: Sequence[float]) -> tuple[float, float]:
    """Amplitude and phase of the model's gravity and amplitude*(sine, cosine) in `values` together."""
    own, phase = get(document, "gravity.amplitude"), get(document, "gravity.phase")
    sine, cosine = own * math.cos(phase) + values[0], own * math.sin(phase) + values[1]
    return math.hypot(sine, cosine), math.atan2(cosine, sine)


def _write(document: Document, values: Sequence[float]) -> None:
    amplitude, phase = _add(document, values)
    document["gravity"] = {"amplitude": amplitude, "phase": phase}


def terms(scene: SearchContext) -> list[Term]:
    """A weight, beside the one that the model has; none on a linear axis, where it would be an offset.

    On a linkage it makes a second wave, which the model has as one of cogging.
    """
    if scene.linear:
        return []
    most = 50.0 * max(scene.dry, scene.effort)
    size = max(scene.dry, 0.1 * scene.effort)
    starts = [(0.0, 0.0), _regressed(scene, most)]

    def second(values: Sequence[float]) -> tuple[float, float]:
        weight = math.hypot(*values[:2])
        return weight * math.hypot(*values[2:]), math.atan2(values[3], values[2])

    def write_linkage(document: Document, values: Sequence[float]) -> None:
        _write(document, values[:2])
        document.setdefault("cogging", {}).setdefault("harmonics", []).append(harmonic(scene, SECOND, *second(values)))

    def report_linkage(document: Document, values: Sequence[float]) -> list[Reported]:
        amplitude, phase = second(values)
        waves = [Reported("amplitude_2", amplitude, scene.force), Reported("phase_2", phase, "rad")]
        return [*report(document, values), *waves]

    def report(document: Document, _values: Sequence[float]) -> list[Reported]:
        units = {"amplitude": scene.force, "phase": "rad"}
        return [Reported(key, get(document, f"gravity.{key}"), unit) for key, unit in units.items()]

    found = []
    for sine, cosine in starts:
        pulls = (("sine", sine), ("cosine", cosine))
        unknowns = tuple(share(key, start, -most, most, size, scene.force) for key, start in pulls)
        found.append(Term("gravity", "weight", unknowns, _write, report))
    if scene.reach >= HALF_TURN:
        waves = tuple(
            share(f"{part}_2", 0.0, -MOST_OF_WEIGHT, MOST_OF_WEIGHT, MOST_OF_WEIGHT) for part in ("sine", "cosine")
        )
        found.append(Term("gravity", "weight on a linkage", (*unknowns, *waves), write_linkage, report_linkage))
    return found


def _regressed(scene: SearchContext, most: float) -> tuple[float, float]:
    """Sine and cosine of the weight from one regression beside the motion: a weight of many frictions is far away."""
    v = scene.velocity
    motion = [scene.acceleration, v, np.tanh(v / (0.02 * scene.speed)), np.ones_like(v)]
    (sine, cosine, *_), _ = scene.fitted([np.sin(scene.position), np.cos(scene.position), *motion])
    return float(np.clip(-sine, -most, most)), float(np.clip(-cosine, -most, most))


EFFECT = Effect(
    name="gravity",
    group=Gravity,
    equation="resisting torque += amplitude*sin(x + phase), on a linkage + amplitude_2*sin(2*x + phase_2)",
    source="a mass m at radius r: amplitude = m*g*r",
    statement="A weight off the axis pulls on it",
    shows="one slow wave of the mismatch over a turn, the same in both directions and at every speed",
    confused=("spring", "cogging", "torque_offset"),
    experiment="slow passes over more than half a turn: a spring goes on growing, gravity turns back",
    terms=terms,
    look=Look("position"),
)
