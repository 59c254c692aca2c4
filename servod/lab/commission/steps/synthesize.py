"""Steps 2 and 3: the model becomes a gain set with its proofs, or the walk says what would have to be relaxed; then the
set is judged from itself alone, and gets its certificate, or gives way to one of less position gain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from servod.common.errors import AnswerIsNo
from servod.common.sources import SYNTHESIZES, VERIFIES, source_sha256
from servod.common.units import NS_PER_S, NS_PER_US
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.commission.state import (
    CERTIFICATE,
    DESIGN,
    GAINS,
    INFEASIBLE,
    MODEL,
    RELAXED,
    read_walk_json,
    write_json,
    write_text,
)
from servod.lab.commission.walk import Walk
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import DesignOptions, synthesize
from servod.lab.synthesize.infeasible import Infeasible, Relaxation
from servod.lab.synthesize.regions import narrowed, uncertainty_of
from servod.lab.verify.certify import SEED, Verification, verify
from servod.lab.verify.checks import INTERVALS_CHECK, PLANTS_CHECK
from servod.lab.verify.effect_checks import PHYSICS_CHECK

#: The regions' overlap ends at this share of the speed at most.
OVERLAP_SHARE = 0.5
#: Position errors count with these shares of their weight, each where the checks refuse the set before: what follows
#: the reference less closely leaves more margin, and comes back where the other swings on.
LADDER = (1.0, 0.3, 0.1)
#: Checks that find something else than too much gain.
NOT_OF_GAIN = (PLANTS_CHECK, PHYSICS_CHECK, INTERVALS_CHECK)
#: What the document has in place of failed checks where not even a design was found.
NO_DESIGN = "no feedback meets the demands"


@dataclass(frozen=True)
class Synthesize:
    """Leaves the set without a certificate, and what was relaxed for it."""

    name: str = "synthesize"
    title: str = "synthesize"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (DESIGN, RELAXED)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The model, the loop around the law, the accuracy of the local sets, and by which sources."""
        loop, accuracy = _loop(walk), walk.options.accuracy
        return {**walk.hashes(MODEL), "loop": loop, "accuracy": accuracy, "tool": source_sha256(SYNTHESIZES)}

    def run(self, walk: Walk) -> None:
        """Raises AnswerIsNo when the demands cannot be met and no relaxation was agreed to."""
        walk.path(INFEASIBLE).unlink(missing_ok=True)
        model = load_axis_model(walk.path(MODEL))
        wishes, taken = _wishes(walk, model), None
        found = _attempt(walk, self.title, model, wishes)
        if isinstance(found, Infeasible):
            report_clashes(walk, found)
            taken = agreed(walk, found)
            found = _attempt(walk, self.title, model, relaxed(model, wishes, taken))
        if isinstance(found, Infeasible):
            report_clashes(walk, found)
            raise AnswerIsNo(f"synthesize: no design even with {taken}")
        write_json(walk.path(RELAXED), asdict(taken) if taken else None)
        write_text(walk.path(DESIGN), found.to_yaml())


def _attempt(walk: Walk, title: str, model: AxisModel, wishes: Wishes) -> GainSet | Infeasible:
    with walk.progress(title) as on_progress:
        on_progress("both regions", 0.1)
        options = DesignOptions(name=f"{walk.axis.config.name.lower()}_local", accuracy=walk.options.accuracy)
        return synthesize(model, wishes, options, walk.path(MODEL))


def report_clashes(walk: Walk, found: Infeasible) -> None:
    """Which vertices clash, and what would help: for people at once, and as a file for the document of the failure."""
    write_json(walk.path(INFEASIBLE), asdict(found))
    for line in found.clashes:
        walk.say(f"clash: {line}")


def _wishes(walk: Walk, model: AxisModel) -> Wishes:
    """What is asked of the design before anything is relaxed."""
    return Wishes(uncertainty=uncertainty_of(model), **_loop(walk))


def _loop(walk: Walk) -> dict[str, Any]:
    """The loop around the law, and up to which speed it is for: no faster than the axis may move and was identified."""
    config = walk.axis.config
    usual = Wishes()
    speed_max = min(usual.speed_max, config.limits.speed_rad_s, walk.options.speed_rad_s or math.inf)
    low, high = usual.overlap
    narrow = min(1.0, OVERLAP_SHARE * speed_max / high)
    return {
        "speed_max": speed_max,
        "overlap": (narrow * low, narrow * high),
        "period_s": config.cycle.period_us * NS_PER_US / NS_PER_S,
        "cutoff_hz": walk.axis.cutoff_hz,
        "counts_per_turn": float(config.encoder.counts_per_turn),
        "torque_limit_nm": config.limits.torque_nm,
        "torque_rate_nm_per_s": config.limits.torque_rate_nm_per_s,
    }


#: Wishes that a relaxation may change, by how the synthesis names them.
_CHANGES: dict[str, Callable[[AxisModel, Wishes, Relaxation], Wishes]] = {
    "scale of the uncertainty": lambda m, w, r: replace(w, uncertainty=narrowed(w.uncertainty, r.enough / r.asked, m)),
    "least decay [1/s]": lambda _, w, r: replace(w, least_decay_per_s=r.enough),
    "least damping ratio": lambda _, w, r: replace(w, least_damping=r.enough),
}


def relaxed(model: AxisModel, wishes: Wishes, relaxation: Relaxation) -> Wishes:
    """The wishes with one of them lowered, a little further than what was found to be just enough."""
    further = replace(relaxation, enough=0.98 * relaxation.enough)
    return _CHANGES[relaxation.wish](model, wishes, further)


def agreed(walk: Walk, found: Infeasible) -> Relaxation:
    """The first relaxation that a person agrees to. Raises AnswerIsNo with all that was offered."""
    offers = [r for r in found.relaxations if r.wish in _CHANGES]
    for relaxation in offers:
        if walk.questions.takes(f"the demands cannot be met together; design with {relaxation}?"):
            walk.say(f"relaxed: {relaxation}")
            return relaxation
    filters = [r for r in found.relaxations if r.wish not in _CHANGES]
    remedies = [f"set encoder.velocity_cutoff_hz to {r.enough:g} in the configuration" for r in filters]
    proposals = [*remedies, *(f"{relaxation} would do by itself (--yes takes the first)" for relaxation in offers)]
    where = " and ".join(found.regions) or "both regions together"
    raise AnswerIsNo(f"synthesize: no feedback for {where}; {'; '.join(proposals) or 'no single relaxation helps'}")


# --- Step 3 ----------------------------------------------------------------------------------------------------------
# The set is judged from itself alone, and gets its certificate; where it is refused, one of less gain is judged.


@dataclass(frozen=True)
class Verify:
    """Leaves the certified gain set, and the document of `servoctl verify --json` with what was refused before it."""

    name: str = "verify"
    title: str = "verify"

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder."""
        return (GAINS, CERTIFICATE)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The set, what others are designed from, how thoroughly they are judged, and by which sources."""
        tools = [source_sha256(SYNTHESIZES), source_sha256(VERIFIES)]
        others = {"loop": _loop(walk), "accuracy": walk.options.accuracy, "ladder": list(LADDER)}
        judged = {"plants": walk.options.plants, "seed": SEED, "tool": tools}
        return {**walk.hashes(DESIGN, MODEL, RELAXED), **others, **judged}

    def run(self, walk: Walk) -> None:
        """Raises AnswerIsNo when no set is valid; then the first one's document stands alone, with no set to deploy."""
        refused: list[dict[str, Any]] = []
        first: dict[str, Any] = {}
        for weight, gains in self._ladder(walk):
            if gains is None:
                refused.append({"position_weight": weight, "failed": [NO_DESIGN]})
                continue
            result = self._judged(walk, gains)
            if result.valid:
                write_json(walk.path(CERTIFICATE), result.document() | ladder_entry(weight, refused))
                write_text(walk.path(GAINS), result.certified(gains).to_yaml())
                return
            failed = [check.name for check in result.checks if not check.passed]
            refused.append({"position_weight": weight, "failed": failed})
            first = first or result.document()
            walk.say(f"verify: not valid: {'; '.join(failed)}")
            if any(name.startswith(NOT_OF_GAIN) for name in failed):
                break
        write_json(walk.path(CERTIFICATE), first | ladder_entry(LADDER[0], refused))
        less_gain = ", and none with less position gain was found or valid" if len(refused) > 1 else ""
        raise AnswerIsNo(f"verify: not valid: {'; '.join(refused[0]['failed'])}{less_gain}")

    def _ladder(self, walk: Walk) -> Iterator[tuple[float, GainSet | None]]:
        """(share of the position error's weight, set if there is one): the step before left the first."""
        yield LADDER[0], load_gains(walk.path(DESIGN))
        model, taken = load_axis_model(walk.path(MODEL)), read_walk_json(walk.path(RELAXED))
        wishes = _wishes(walk, model)
        if taken:
            wishes = relaxed(model, wishes, Relaxation(**taken))
        for weight in LADDER[1:]:
            walk.say(f"verify: a design in which position errors count with {weight:g} of their weight")
            found = _attempt(walk, self.title, model, replace(wishes, position_weight=weight * wishes.position_weight))
            yield weight, found if isinstance(found, GainSet) else None

    def _judged(self, walk: Walk, gains: GainSet) -> Verification:
        with walk.progress(self.title) as on_progress:
            on_progress(f"{walk.options.plants} plants", 0.1)
            options, where = walk.options, str(walk.path(DESIGN))
            return verify(gains, options.plants, SEED, options.processes, where, least_plants=options.least_plants)


def ladder_entry(weight: float, refused: list[dict[str, Any]]) -> dict[str, Any]:
    """Which set of the ladder a document is of, and what the checks found in those that they refused."""
    return {"position_weight": weight, "refused": refused}
