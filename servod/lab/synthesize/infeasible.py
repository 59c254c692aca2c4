"""Why there is no design: regions and vertices that clash, and the smallest relaxation that would do.

Beside the deployed mode, which it asks again with less; the reference mode tells its own refusals in the same words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.model.axis_model import AxisModel
from servod.lab.synthesize.deployed import (
    CUTOFFS_HZ,
    SLOW_DISCS,
    Wishes,
    bare_proof,
    empty_design,
    programme,
    region,
    regions,
)
from servod.lab.synthesize.lmi_deployed import first_feedback
from servod.lab.synthesize.regions import delay_refusal, narrowed
from servod.lab.verify.proof import scaled_vertices
from servod.lab.verify.vertices import Span

#: Halvings of the interval in which the largest feasible factor lies.
RELAX_STEPS = 6


@dataclass(frozen=True, slots=True)
class Relaxation:
    """The smallest change found that makes a design feasible; offered, never taken."""

    wish: str
    asked: float
    enough: float

    def __str__(self) -> str:
        return f"{self.wish} {self.enough:.3g} instead of {self.asked:.3g}"


@dataclass(frozen=True, slots=True)
class Infeasible:
    """No design: which regions failed at which vertices, and what would help."""

    regions: tuple[str, ...]
    clashes: tuple[str, ...]
    relaxations: tuple[Relaxation, ...]


def clashing_vertices(design: Design, span: Span, wishes: Wishes) -> Iterator[str]:
    """Vertices that no feedback of the grid keeps inside their disc, alone or together with the others."""
    frame = bare_proof(design, span, wishes)
    p = programme(design, frame, wishes)
    feedback = np.concatenate([first_feedback(p), np.zeros(p.a.shape[-1] - p.fed)])
    poles = np.linalg.eigvals(p.a + p.b[:, :, None] * feedback)
    found, _, _, _ = scaled_vertices(design, frame)
    for joint, roots, (centre, radius) in zip(found, poles, p.discs, strict=False):
        outside = float(np.abs(roots - centre).max()) / radius
        if outside >= 1.0:
            yield f"{span.name}: {joint.name}: poles at {outside:.3f} of the disc (1 allowed)"


def explain(model: AxisModel, wishes: Wishes) -> Infeasible:
    """Why there is no design, and the smallest relaxation of each wish that alone makes one."""
    late = delay_refusal(model, wishes.period_s)
    if late is not None:
        return Infeasible(tuple(span.name for span in wishes.spans), (late,), ())
    design = empty_design(model, wishes, wishes.cutoff_hz or CUTOFFS_HZ[-1])
    failed = [span for span in wishes.spans if region(design, span, wishes) is None]
    clashes = [line for span in failed for line in clashing_vertices(design, span, wishes)]
    return Infeasible(tuple(s.name for s in failed), tuple(clashes), tuple(relaxations(model, wishes)))


def relaxations(model: AxisModel, wishes: Wishes) -> Iterator[Relaxation]:
    """Each wish lowered by itself until a design exists; wishes that do not help even at their end are left out."""
    slow = wishes.slow_disc or SLOW_DISCS[-1]
    fixed = replace(wishes, cutoff_hz=wishes.cutoff_hz or CUTOFFS_HZ[-1], slow_disc=slow)

    def shrunk(factor: float) -> Wishes:
        return replace(fixed, uncertainty=narrowed(wishes.uncertainty, factor, model))

    def slower(factor: float) -> Wishes:
        return replace(fixed, least_decay_per_s=factor * wishes.least_decay_per_s)

    def rougher(factor: float) -> Wishes:
        return replace(fixed, least_damping=factor * wishes.least_damping)

    def designs(change: Callable[[float], Wishes]) -> Callable[[float], bool]:
        return lambda factor: regions(model, change(factor)) is not None

    for wish, asked, change in (
        ("scale of the uncertainty", 1.0, shrunk),
        ("least decay [1/s]", wishes.least_decay_per_s, slower),
        ("least damping ratio", wishes.least_damping, rougher),
    ):
        factor = largest_factor(designs(change))
        if factor is not None:
            yield Relaxation(wish, asked, factor * asked)
    for cutoff in CUTOFFS_HZ:
        if wishes.cutoff_hz and cutoff > wishes.cutoff_hz and regions(model, replace(fixed, cutoff_hz=cutoff)):
            yield Relaxation("cut-off of the velocity filter [Hz]", wishes.cutoff_hz, cutoff)
            return


def largest_factor(feasible: Callable[[float], bool]) -> float | None:
    """Largest factor below 1 that is feasible, by bisection; None when even 0.02 is not."""
    low, high = 0.02, 1.0
    if not feasible(low):
        return None
    for _ in range(RELAX_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if feasible(middle) else (low, middle)
    return low
