"""Tuning of one law in one class: the search over its numbers, on the plants of the trial, to a gain set.

Stands on search, trial and laws. The result is a normal gain set that says where it comes from; nothing proves it, so
an axis runs it only when it accepts uncertified sets.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable

import numpy as np

from servod import __version__
from servod.axis_model import AxisModel
from servod.gain_parameters import Parameters
from servod.gains import GainSet, Provenance
from servod.tune.laws import PAPER_FEEDBACK, RIVALS, Axis, Rival
from servod.tune.plan import Feedback, Tuned, TunePlan
from servod.tune.search import Array, least
from servod.tune.trial import Trial

#: Told how much of a tuning is done, from 0 to 1.
Tell = Callable[[float], None]
#: The numbers of a set that was tuned, by the names of their ranges.
Values = dict[str, float]


def tune(
    model: AxisModel,
    name: str,
    feedback: Feedback,
    plan: TunePlan,
    start: Values | None = None,
    tell: Tell | None = None,
) -> Tuned:
    """Tune the rival `name` (a key of servod.tune.laws.RIVALS) in one class; the same arguments give the same set.

    `start` are values that are tried beside the usual start; those of the equal class, for the free one, make sure that
    more freedom is never worse. Raises BadInput when the model has no bristle stiffness to compensate.
    """
    rival, trial = RIVALS[name], Trial(Axis(model, plan))
    ranges = rival.space(feedback)
    candidates = plan.budget // plan.plants if ranges else 1
    done = 0

    def values(shares: Array) -> Values:
        return {key: r.at(float(share)) for (key, r), share in zip(ranges.items(), shares, strict=True)}

    def cost(shares: Array) -> float:
        nonlocal done
        done += 1
        if tell:
            tell(done / candidates)
        return trial.cost(rival.build(trial.axis, values(shares))).value

    starts = [{key: r.start for key, r in ranges.items()}, *([{**PAPER_FEEDBACK, **start}] if start else [])]
    shares = [np.array([r.share(point[key]) for key, r in ranges.items()]) for point in starts]
    best = values(least(cost, shares, candidates, plan.seed))
    parameters = rival.build(trial.axis, best)
    reached = trial.cost(parameters)
    gains = gain_set(name, rival, feedback, plan, parameters)
    return Tuned(gains, reached.value, done * plan.plants, reached.roughness, best)


def as_tuned(model: AxisModel, gains: GainSet, plan: TunePlan) -> Tuned:
    """A set that came in another way, by the measures of a tuning: its cost and its roughness on the same plants."""
    reached = Trial(Axis(model, plan)).cost(gains.parameters)
    return Tuned(gains, reached.value, plan.plants, reached.roughness, {})


def gain_set(name: str, rival: Rival, feedback: Feedback, plan: TunePlan, parameters: Parameters) -> GainSet:
    """The tuned numbers as a gain set with their provenance, uncertified."""
    tuned = ", ".join(rival.space(feedback)) or "nothing"
    return GainSet(
        schema_version=1,
        name=f"tuned_{name}_{feedback.value}",
        description=f"Tuned rival for comparison, {feedback.value} feedback; no design and no certificate.",
        parameters=parameters,
        provenance=Provenance(
            author="servod",
            date=datetime.datetime.now(datetime.UTC).date(),
            tool=f"servod {__version__} tune",
            seed=plan.seed,
            note=f"Tuned: {tuned}; {plan.budget} simulated plants, {plan.plants} for each set that was tried, velocity "
            f"filter {plan.cutoff_hz:g} Hz, roughness at most {plan.roughness_limit:g} times the paper's PD.",
        ),
    )
