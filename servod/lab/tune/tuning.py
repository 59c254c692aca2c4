"""Tuning of one law in one class: the search over its numbers, on the plants of the trial, to a gain set.

Stands on search, trial and laws. The result is a normal gain set that says where it comes from; nothing proves it, so
an axis runs it only when it accepts uncertified sets.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from servod import __version__
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import Parameters
from servod.formats.model.axis_model import AxisModel
from servod.lab.tune.laws import PAPER_FEEDBACK, RIVALS, Axis, Range, Rival
from servod.lab.tune.plan import Feedback, Tuned, TunePlan
from servod.lab.tune.search import Array, least
from servod.lab.tune.trial import Trial

#: Told how much of a tuning is done, from 0 to 1.
Tell = Callable[[float], None]
#: The numbers of a set that was tuned, by the names of their ranges.
Values = dict[str, float]


def tune(
    model: AxisModel,
    name: str,
    feedback: Feedback,
    plan: TunePlan,
    starts: Sequence[Values] = (),
    tell: Tell | None = None,
) -> Tuned:
    """Tune the rival `name` (a key of servod.lab.tune.laws.RIVALS) in one class; the same arguments give the same set.

    `starts` are values that are tried beside the usual start: those of the equal class for the free one, and those of
    its forerunners, make sure that more freedom is never worse. Raises BadInput when the model has no bristle stiffness
    to compensate.
    """
    rival, trial = RIVALS[name], Trial(Axis(model, plan))
    ranges, candidates = rival.space(feedback), candidates_of(rival, feedback, plan)
    done = 0

    def values(shares: Array) -> Values:
        return {**rival.fixed, **{k: r.at(float(s)) for (k, r), s in zip(ranges.items(), shares, strict=True)}}

    def cost(shares: Array) -> float:
        nonlocal done
        done += 1
        if tell:
            tell(done / candidates)
        return trial.cost(rival.build(trial.axis, values(shares))).value

    best = values(least(cost, _shares(ranges, starts), candidates, plan.seed))
    parameters = rival.build(trial.axis, best)
    reached = trial.cost(parameters)
    gains = gain_set(name, rival, feedback, plan, parameters)
    return Tuned(gains, reached.value, done * plan.plants, reached.roughness, best)


def candidates_of(rival: Rival, feedback: Feedback, plan: TunePlan) -> int:
    """How many sets one search of a rival may try: its part of the law's budget, or one where nothing is tuned."""
    return plan.budget // (plan.plants * rival.searches) if rival.space(feedback) else 1


def _shares(ranges: Mapping[str, Range], starts: Sequence[Values]) -> list[Array]:
    """The usual start and `starts` as shares of the ranges; feedback that a start does not name is the paper's."""
    points = [{key: r.start for key, r in ranges.items()}, *({**PAPER_FEEDBACK, **start} for start in starts)]
    return [np.array([r.share(point[key]) for key, r in ranges.items()]) for point in points]


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
            note=f"Tuned: {tuned}; {candidates_of(rival, feedback, plan) * plan.plants} simulated plants of the law's "
            f"{plan.budget}, {plan.plants} for each set that was tried, velocity "
            f"filter {plan.cutoff_hz:g} Hz, roughness at most {plan.roughness_limit:g} times the paper's PD.",
        ),
    )
