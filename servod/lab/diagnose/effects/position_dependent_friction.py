"""Dry friction that changes along the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servod.formats.model.friction import PositionDependentFriction
from servod.lab.diagnose.effects.effect import Effect, harmonic, report_as_is, sine_term
from servod.lab.diagnose.effects.hypothesis import Document, Term, Unknown
from servod.lab.diagnose.effects.looks import Look, Split
from servod.lab.diagnose.effects.search_context import Peak, SearchContext

#: Half waves along the way that make a profile.
PROFILE = 4


def _write_bump(document: Document, values: Sequence[float]) -> None:
    group = document.setdefault("position_dependent_friction", {})
    group.setdefault("bumps", []).append({"factor": values[0], "position": values[1], "width": values[2]})


def _bumps(scene: SearchContext) -> list[Term]:
    """Tight spots where the mismatch opposed to the motion is strongest."""
    against = -scene.mismatch * np.sign(scene.velocity) / scene.dry
    rows = scene.predictor.counts & (np.abs(scene.velocity) > 0.02 * scene.speed)
    edges = np.linspace(scene.position.min(), scene.position.max(), 25)
    bins = np.clip(np.digitize(scene.position[rows], edges) - 1, 0, 23)
    sums = np.bincount(bins, against[rows], 24)
    mean = sums / np.maximum(np.bincount(bins, minlength=24), 50)
    strongest = int(np.argmax(np.abs(mean - np.median(mean))))
    low, high = float(edges[0]), float(edges[-1])
    found = []
    for width in (0.05, 0.15):
        unknowns = (
            Unknown("factor", "1", float(np.clip(mean[strongest], -0.5, 2.0)), -0.9, 10.0, 0.5),
            Unknown(
                "position",
                scene.length,
                0.5 * float(edges[strongest] + edges[strongest + 1]),
                low,
                high,
                0.1 * scene.reach,
            ),
            Unknown("width", scene.length, width * scene.reach, 0.01 * scene.reach, 0.5 * scene.reach),
        )
        found.append(Term("position_dependent_friction", "tight spot", unknowns, _write_bump, report_as_is(unknowns)))
    return found


def terms(scene: SearchContext) -> list[Term]:
    """Sines over position whose period is searched, one of low order, a tight spot, and a profile of the whole way."""
    carrier = -scene.dry * np.tanh(scene.velocity / (0.02 * scene.speed))
    peaks = scene.peaks(scene.carried(carrier), 2)
    low = Peak(2.0 * np.pi / scene.reach, 0.0, 0.0, 0.0)
    found = [sine_term("position_dependent_friction", scene, peak, 0.3, "1", most=0.95) for peak in (*peaks, low)]
    return found + _bumps(scene) + ([_profile(scene)] if scene.fine else [])


def _profile(scene: SearchContext) -> Term:
    """A smooth profile: half-range cosines from one end of the way to the other."""
    first, count = float(scene.position.min()), PROFILE
    unknowns = tuple(Unknown(f"wave_{k}", "1", 0.0, -0.9, 0.9, 0.3) for k in range(1, count + 1))

    def write(document: Document, values: Sequence[float]) -> None:
        rows = document.setdefault("position_dependent_friction", {}).setdefault("harmonics", [])
        for k, amplitude in enumerate(values, 1):
            n = k * np.pi / scene.reach
            phase = float(np.pi / 2.0 - np.remainder(n * first, 2.0 * np.pi))
            rows.append(harmonic(scene, n, amplitude, phase))

    return Term("position_dependent_friction", "profile", unknowns, write, report_as_is(unknowns))


EFFECT = Effect(
    name="position_dependent_friction",
    group=PositionDependentFriction,
    equation="g -> g*(1 + sum amplitude*sin(n*x + phase) + sum factor*exp(-(x - position)^2/(2*width^2)))",
    source="gear mesh and bearing preload; Armstrong-Helouvry, Control of Machines with Friction, 1991",
    statement="Dry friction changes along the way",
    shows="a mismatch over position that changes sign with the direction of motion",
    confused=("load_dependent_friction", "cogging", "gravity"),
    experiment="slow passes over the whole range in both directions, with and without a weight",
    terms=terms,
    look=Look("position", Split.DIRECTION),
    repeatable=True,
)
