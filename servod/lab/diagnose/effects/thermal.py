"""Thermal: friction changes with temperature or time."""

from __future__ import annotations

from collections.abc import Sequence

from servod.formats.model.friction import Thermal
from servod.lab.diagnose.effects.effect import Effect, report_as_is, share, simple
from servod.lab.diagnose.effects.hypothesis import Document, Term, Unknown
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import SearchContext


def terms(scene: SearchContext) -> list[Term]:
    """By the recorded temperature where there is one, linear and exponential; by time; by recording."""
    found = []
    if scene.warm:
        rates = [share(key, 0.0, -0.5, 0.5, 0.05, "1/°C") for key in ("dry_per_c", "viscous_per_c")]
        found.append(simple("thermal", "temperature", rates, shape="exponential"))
        found.append(simple("thermal", "temperature, straight", rates, shape="linear"))
    length = max(scene.duration_s, 1e-3)
    drifts = [
        share(key, 0.0, -3.0 / length, 3.0 / length, 0.3 / length, "1/s") for key in ("dry_per_s", "viscous_per_s")
    ]
    count = len(scene.predictor.traces)
    between = [_between(drifts, count)] if count > 1 else []
    return [*found, simple("thermal", "drift", drifts), *between]


def _between(drifts: list[Unknown], recordings: int) -> Term:
    """A drift, and another level of friction in each recording than in the first: a colder lubricant."""
    names = [f"{kind}_recording_{n}" for n in range(2, recordings + 1) for kind in ("dry", "viscous")]
    levels = [share(name, 0.0, -0.8, 4.0, 1.0) for name in names]

    def each(document: Document, values: Sequence[float], recording: int) -> None:
        if recording == 0:
            return
        dry, viscous = values[2 * recording : 2 * recording + 2]
        for key, more in (("coulomb", dry), ("static", dry), ("viscous", viscous)):
            if key in document["friction"]:
                document["friction"][key] *= 1.0 + more

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
