"""The reference mode: the paper's programme over both regions, made into a gain set, or the answer why it cannot be.

Stands on the LMIs of one region and on the local sets. The polytope is what the law really does (its sets, its leak
floor, c0_hat) against the model within its intervals. A solution is taken only when it holds by eigenvalues.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from servod.formats.gains.design import Design, DesignMode, ReferenceProof
from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters, RegionGains, Regions
from servod.formats.model.axis_model import AxisModel
from servod.lab.synthesize.deployed import Wishes, empty_design
from servod.lab.synthesize.gain_set import DesignOptions, gain_set, parameters
from servod.lab.synthesize.infeasible import Infeasible, Relaxation, largest_factor
from servod.lab.synthesize.lmi_reference import ReferenceAnswer, ReferenceWishes, reference
from servod.lab.synthesize.regions import narrowed
from servod.lab.verify.reference_proof import gain_numbers, polytope, reference_gains, reference_margin
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction
from servod.lab.verify.vertices import Span

CUTOFF_HZ = 300.0  # of the velocity filter, which this mode does not know
LEAKS_PER_S = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
STRICTNESS = (1e-6, 1e-5, 1e-4)  # tried in turn until the solution also holds by eigenvalues


@dataclass(frozen=True, slots=True)
class ReferenceFrame:
    """Everything but the feedback: the axis, the law around it, and what is asked."""

    friction: SteadyFriction
    design: Design
    law: LocalParameters
    spans: tuple[Span, Span]
    asked: ReferenceWishes

    def answer(self, span: Span, why: bool = True) -> ReferenceAnswer:
        """The proof of one region, held by eigenvalues and with a feedback that the law may have; or the clash.

        Without `why` no clash is searched for.
        """
        intervals = polytope(self.friction, self.law.friction, span, self.design.uncertainty)
        problems: list[str] = []
        for strict in STRICTNESS:
            found = reference(self.friction, span, intervals, self.asked, strict, why and not problems)
            if found.proof is None:
                return ReferenceAnswer(None, None, tuple(problems) or found.clashes)
            problems = usable(self.design, found.proof)
            if not problems:
                return found
        return ReferenceAnswer(None, None, tuple(problems))

    def feasible(self, span: Span) -> bool:
        """Whether the region has a usable solution; no search for what clashes."""
        return self.answer(span, why=False).proof is not None


def usable(design: Design, proof: ReferenceProof) -> list[str]:
    """Why a solution is no feedback for the law; empty when it is one."""
    margin = reference_margin(design, proof)
    if margin <= 0.0:
        return [f"{proof.name}: the solver's matrices do not hold by eigenvalues (least relative one {margin:.2g})"]
    _, position, speed = gain_numbers(proof)
    if position < 0.0 or speed < 0.0:
        return [f"{proof.name}: only with positive feedback, k_x = {position:.3g}, k_v = {speed:.3g}"]
    return []


def frame(model: AxisModel, wishes: Wishes, options: DesignOptions, asked: ReferenceWishes) -> ReferenceFrame:
    """The law without feedback, as the deployed mode makes it, and the intervals around it."""
    friction = steady_friction(model)
    design = empty_design(model, wishes, wishes.cutoff_hz or CUTOFF_HZ).model_copy(
        update={"mode": DesignMode.REFERENCE, "accuracy": options.accuracy}
    )
    none = RegionGains(k_x_per_rad=0.0, k_v_s_per_rad=0.0)
    low, high = wishes.spans
    bare = Regions(low=none, high=none, overlap_from_rad_s=high.from_rad_s, overlap_to_rad_s=low.to_rad_s)
    law = parameters(design, friction, options, 0.0, bare)
    return ReferenceFrame(friction, design, law, wishes.spans, replace(asked, input_scale_nm=law.input_scale_nm))


def reference_set(
    model: AxisModel,
    wishes: Wishes | None = None,
    options: DesignOptions | None = None,
    asked: ReferenceWishes | None = None,
    model_path: Path | None = None,
) -> GainSet | Infeasible:
    """The gain set of the reference mode, sealed and not yet certified; or which vertices and constraints clash."""
    wishes, options, asked = wishes or Wishes(), options or DesignOptions(), asked or ReferenceWishes()
    made = frame(model, wishes, options, asked)
    answers = [made.answer(span) for span in made.spans]
    proofs = [answer.proof for answer in answers if answer.proof is not None]
    if len(proofs) < len(answers):
        failed = tuple(span.name for span, a in zip(made.spans, answers, strict=True) if a.proof is None)
        clashes = tuple(line for answer in answers for line in answer.clashes)
        return Infeasible(failed, clashes, tuple(relaxations(model, wishes, options, asked)))
    gains = {proof.name: reference_gains(proof) for proof in proofs}
    law = made.law.model_copy(update={"regions": made.law.regions.model_copy(update=gains)})
    return gain_set(made.design.model_copy(update={"reference": proofs}), law, options, model_path)


def relaxations(
    model: AxisModel, wishes: Wishes, options: DesignOptions, asked: ReferenceWishes
) -> Iterator[Relaxation]:
    """Each wish lowered by itself until both regions have a solution; those that do not help are left out."""

    def feasible(w: Wishes, o: DesignOptions, a: ReferenceWishes) -> bool:
        made = frame(model, w, o, a)
        return all(made.feasible(span) for span in made.spans)

    def narrower(factor: float) -> bool:
        return feasible(replace(wishes, uncertainty=narrowed(wishes.uncertainty, factor, model)), options, asked)

    shrunk = largest_factor(narrower)
    if shrunk is not None:
        yield Relaxation("scale of the uncertainty", 1.0, shrunk)
    decay, damping = asked.least_decay_per_s, asked.least_damping
    slower = largest_factor(lambda f: feasible(wishes, options, replace(asked, least_decay_per_s=f * decay)))
    if slower is not None:
        yield Relaxation("least decay [1/s]", decay, slower * decay)
    rougher = largest_factor(lambda f: feasible(wishes, options, replace(asked, least_damping=f * damping)))
    if rougher is not None:
        yield Relaxation("least damping ratio", damping, rougher * damping)
    if options.gain and feasible(wishes, replace(options, gain=0.0), asked):
        yield Relaxation("l", options.gain, 0.0)
    for leak in LEAKS_PER_S:
        if leak > options.leak_per_s and feasible(wishes, replace(options, leak_per_s=leak), asked):
            yield Relaxation("leak of the friction state [1/s]", options.leak_per_s, leak)
            return
