"""Every law tuned by the same rules on the identified joint, then measured on the joint itself: the fair comparison.

Jobs of the crew; stands on servod.lab.tune. Tuning sees the model and its intervals, scoring the plant, with other
seeds.
"""

from __future__ import annotations

from dataclasses import dataclass

from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.lab.tune.plan import Feedback, TunePlan
from servod.lab.tune.rivals import tuned_in_turn
from servod.qualify.paper.experiments import Measured, measure
from servod.qualify.paper.joints import ENCODER_COUNTS, Joint

#: What people read, by the rival's key in servod.lab.tune.laws.RIVALS.
LABELS = {
    "pd": "PD",
    "pd_dob": "PD + DOB",
    "pd_lugre": "PD + LuGre, l_f tuned",
    "pd_lugre_025": "PD + LuGre, l_f 0.25",
    "pd_lugre_035": "PD + LuGre, l_f 0.35",
    "local": "local",
}
#: Rivals by the law that they run: one job tunes those of a law, for they start from each other.
FAMILIES = (("pd",), ("pd_dob",), ("pd_lugre", "pd_lugre_025", "pd_lugre_035"), ("local",))
#: Between the seeds of tuning and of scoring.
SCORING_SEED_OFFSET = 100


@dataclass(frozen=True)
class Contender:
    """One tuned law: what people read of it, its class, and what it did on the joint."""

    law: str
    feedback: Feedback
    measured: Measured


def tuned_sets(
    model: AxisModel, names: tuple[str, ...], cutoff_hz: float, seed: int
) -> dict[tuple[Feedback, str], GainSet]:
    """The rivals `names`, which share one law and its budget, in both classes, tuned for `model` in its intervals."""
    plan = TunePlan(seed=seed, counts_per_turn=float(ENCODER_COUNTS), cutoff_hz=cutoff_hz)
    return {key: found.gains for key, found in tuned_in_turn(model, names, plan).items()}


def score(
    joint: Joint, name: str, feedback: Feedback, gains: GainSet, cutoff_hz: float, seed: int, seconds: float
) -> Contender:
    """Track (19) with one tuned set over the whole CAN loop."""
    label = f"{LABELS[name]}, {feedback.value} feedback"
    found = measure(joint, label, gains, cutoff_hz, seed + SCORING_SEED_OFFSET, seconds, 0.0)
    return Contender(LABELS[name], feedback, found)
