"""Thermal: friction changes with temperature or time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servod.formats.model.friction import Thermal
from servod.lab.diagnose.effects.effect import Effect, positive, report_as_is, scale_friction, share, simple
from servod.lab.diagnose.effects.hypothesis import Document, Term, Unknown
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext

#: Recordings from which on their order says that it was time that passed.
LEAST_IN_ORDER = 3

#: Share of the way to the last level that a recording leaves to those behind it: what warms up does so ever slower.
STILL_TO_GO = 0.7

#: Time in which a drift ends, as a share of the longest recording: a first guess.
FIRST = 0.3


def terms(scene: SearchContext) -> list[Term]:
    """By the recorded temperature where there is one, linear and exponential; by time; by the recordings' order."""
    found = []
    if scene.warm:
        rates = [share(key, 0.0, -0.5, 0.5, 0.05, "1/°C") for key in ("dry_per_c", "viscous_per_c")]
        found.append(simple("thermal", "temperature", rates, shape="exponential"))
        found.append(simple("thermal", "temperature, straight", rates, shape="linear"))
    length = max(scene.duration_s, 1e-3)
    drifts = [
        share(key, 0.0, -3.0 / length, 3.0 / length, 0.3 / length, "1/s") for key in ("dry_per_s", "viscous_per_s")
    ]
    between = [_between(drifts, len(scene.predictor.traces))] if _order_informs(scene) else []
    lasts = positive("drift_time_s", "s", FIRST * length, 10.0)
    return [
        *found,
        simple("thermal", "drift", drifts),
        simple("thermal", "drift that ends", [*drifts, lasts]),
        *between,
    ]


def _order_informs(scene: SearchContext) -> bool:
    """Whether recordings may differ by their place in time: there are enough of them, and no thermometer says more.

    Two recordings stand in an order whatever differs between them.
    """
    measured = all(bool(np.isfinite(trace.drive.temperature_c).all()) for trace in scene.predictor.traces)
    return len(scene.predictor.traces) >= LEAST_IN_ORDER and not measured


def _between(drifts: list[Unknown], recordings: int) -> Term:
    """A drift, and a level of friction that goes on from recording to recording in their order, ever slower.

    Two numbers however many recordings there are: any two recordings predict the level of another.
    """
    levels = [share(name, 0.0, -0.8, 4.0, 1.0) for name in ("dry_at_last", "viscous_at_last")]

    def each(document: Document, values: Sequence[float], recording: int) -> None:
        dry, viscous = values[2:]
        reached = (1.0 - STILL_TO_GO**recording) / (1.0 - STILL_TO_GO ** (recordings - 1))
        scale_friction(document, 1.0 + dry * reached, 1.0 + viscous * reached)

    drift = simple("thermal", "drift", drifts)

    def write(document: Document, values: Sequence[float]) -> None:
        drift.write(document, values[:2])

    unknowns = (*drifts, *levels)
    return Term("thermal", "between recordings", unknowns, write, report_as_is(unknowns), each=each)


EFFECT = Effect(
    name="thermal",
    group=Thermal,
    equation="dry and viscous friction times 1 + k*(T - reference_c), exp(k*(T - reference_c)) or 1 + k_t*t",
    source="Bittencourt and Gunnarsson, ASME JDSMC 134(5), 2012; Simoni et al., IROS 2015",
    statement="Friction changes as the joint warms up or as time passes",
    shows="a mismatch opposed to the motion that drifts over the recording or from one recording to the next",
    confused=("viscous_nonlinear", "load_dependent_friction", "stribeck"),
    experiment="the same motion cold and warm",
    terms=terms,
    look=Look("time", Split.DIRECTION),
)
