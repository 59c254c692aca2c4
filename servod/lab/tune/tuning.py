"""Tuning of one law in one class: the search over its numbers, on the plants of the trial, to a gain set.

Stands on search, trial and laws. The result is a normal gain set that says where it comes from; nothing proves it, so
an axis runs it only when it accepts uncertified sets.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod import __version__
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import Parameters
from servod.formats.model.axis_model import AxisModel
from servod.lab.tune.laws import PAPER_FEEDBACK, RIVALS, Axis, Range, Rival
from servod.lab.tune.plan import Feedback, Tuned, TunePlan
from servod.lab.tune.trial import Trial

# The bounded optimiser, the same for every law: even points over the whole range, then a simplex from the best.
#
# Derivative-free: costs of simulated plants with stiction and encoder steps have no useful slope. Sobol points look for
# a better valley than that of the start, Nelder-Mead (with bounds, adaptive to the dimension) walks down in it. On
# these costs that beat differential evolution by up to 40 % at equal budget, and two descents by 10 %. All numbers are
# shares (0 to 1) of their ranges. Deterministic for a given seed.


Array = NDArray[np.float64]
Objective = Callable[[Array], float]

#: Share of the budget that looks everywhere; the rest descends.
LOOK_SHARE = 0.15
SIMPLEX = 0.12  # edge of the first simplex


class _Spent(Exception):
    """The budget is spent; ends an optimiser that knows no exact limit."""


@dataclass
class _Counted:
    """The objective with a hard budget and a memory of all that was tried."""

    objective: Objective
    budget: int

    def __post_init__(self) -> None:
        self.tried: list[tuple[float, Array]] = []

    def __call__(self, shares: Array) -> float:
        if len(self.tried) >= self.budget:
            raise _Spent
        value = self.objective(np.clip(shares, 0.0, 1.0))
        self.tried.append((value, np.clip(shares, 0.0, 1.0)))
        return value

    def best(self) -> Array:
        """The best point; of equal ones the first."""
        return min(self.tried, key=lambda pair: pair[0])[1]


def least(objective: Objective, starts: Sequence[Array], budget: int, seed: int) -> Array:
    """Shares (0 to 1 each) where `objective` is least, after at most `budget` calls; `starts` are the first of them."""
    counted = _Counted(objective, max(budget, len(starts)))
    for start in starts:
        counted(start)
    if len(starts[0]):
        _look(counted, len(starts[0]), round(LOOK_SHARE * budget), seed)
        _descend(counted, counted.best())
    return counted.best()


def _look(counted: _Counted, dimensions: int, points: int, seed: int) -> None:
    from scipy.stats import qmc

    even = qmc.Sobol(dimensions, scramble=False).random_base2(math.ceil(math.log2(max(points, 1))))
    moved = (even + np.random.default_rng(seed).uniform(size=dimensions)) % 1.0  # the seed's own points, as even
    for shares in moved[: min(points, counted.budget - len(counted.tried))]:
        counted(shares)


def _descend(counted: _Counted, start: Array) -> None:
    from scipy.optimize import minimize

    simplex = np.tile(start, (len(start) + 1, 1))
    for i, share in enumerate(start):
        simplex[i + 1, i] = share + SIMPLEX if share + SIMPLEX <= 1.0 else share - SIMPLEX
    options = {"initial_simplex": simplex, "adaptive": True, "maxfev": 10**6, "xatol": 1e-3, "fatol": 1e-6}
    try:
        minimize(counted, start, method="Nelder-Mead", bounds=[(0.0, 1.0)] * len(start), options=options)
    except _Spent:
        return


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
