"""Tuning of one law in one class: the search over its numbers, on the plants of the trial, to a gain set.

Stands on search, trial and laws. The result is a normal gain set that says where it comes from; nothing proves it, so
an axis runs it only when it accepts uncertified sets.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servod import __version__
from servod.common.progress import OnShare
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import Parameters
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import LAWS
from servod.kernels.scoring import SETTLE_S
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import simulate_closed_loop
from servod.lab.synthesize.regions import uncertainty_of
from servod.lab.tracking.metrics import STEPS_MRAD, Array, paper_rows
from servod.lab.tune.laws import PAPER_FEEDBACK, RIVALS, AxisFacts, Range, Rival
from servod.lab.tune.plan import Feedback, Tuned, TuningSettings
from servod.lab.verify.plants import drawn
from servod.lab.verify.trials import RIPPLE_LIMIT_RAD

# --- The cost of a set -----------------------------------------------------------------------------------------------
# What one gain set costs on the plants of a tuning: the same motion, plants, noise and rules for every law. Cost in
# mrad: the RMS error on (19), with the error of held steps beside it, times what the set pays for rough torque, for
# restlessness and for plants that run away.


#: Of (19): both reversals and both directions, sliding through the fall of the Stribeck curve.
PAPER_S = 6.0
REST_S, HOLD_S = 0.5, 1.2
#: A held step counts from here on: all laws have the same time to get there.
HELD_FROM_S = 0.3
#: The trajectory is what is compared first.
HELD_WEIGHT = 0.3
#: Rest is judged over the last part of a hold, as the certificate's trials judge it.
RIPPLE_S = 0.2
#: A tenth over a limit doubles the cost.
PENALTY = 10.0
LOST_MRAD = 1e4
#: The last plant has this much more delay, in periods: what is tuned shall not stand on the edge.
EXTRA_DELAY = 0.5


class Cost(NamedTuple):
    """What the search makes least [mrad], and the roughness as a multiple of the paper's PD."""

    value: float
    roughness: float


class Followed(NamedTuple):
    """One plant's run: errors in mrad RMS, torque change RMS in N*m, ripple in rad."""

    paper_mrad: float
    held_mrad: float
    roughness_nm: float
    ripple_rad: float


@dataclass(frozen=True)
class TuningObjective:
    """The plants of one tuning and the motion; judges gain sets by their law and packed parameters."""

    axis: AxisFacts

    @cached_property
    def plants(self) -> list[AxisModel]:
        """The model's own draws from its intervals; the last with more delay."""
        plan, model = self.axis.plan, with_noise(self.axis.model, self.axis.plan.loop.resolution_rad)
        plants = [drawn(model, uncertainty_of(model), plan.seed, i) for i in range(plan.plants)]
        return [*plants[:-1], _later(plants[-1], EXTRA_DELAY * plan.period_s)]

    @cached_property
    def motion(self) -> Array:
        """Trajectory (19), rest, and the steps with their holds."""
        period_s = self.axis.plan.period_s
        parts = [paper_rows(period_s, PAPER_S)]
        for offset_mrad, seconds in self._stands():
            rows = np.zeros((round(seconds / period_s), 3))
            rows[:, 0] = parts[0][-1, 0] + offset_mrad * 1e-3
            parts.append(rows)
        return np.concatenate(parts)

    def _stands(self) -> list[tuple[float, float]]:
        """(offset in mrad, seconds) of the rest and of each held step."""
        offsets = np.cumsum(STEPS_MRAD).tolist()
        return [(0.0, REST_S), *((offset, HOLD_S) for offset in offsets)]

    @cached_property
    def noise(self) -> list[tuple[Array, Array]]:
        """Torque and encoder noise of each plant: the same for every gain set."""
        plan = self.axis.plan
        return [
            noise_series(plant.noise, len(self.motion), plan.period_s, seed)
            for plant, seed in zip(self.plants, noise_seeds(plan), strict=True)
        ]

    @cached_property
    def reference_roughness_nm(self) -> float:
        """Torque change of the paper's PD gains on these plants."""
        return _rms([run.roughness_nm for run in self.runs(self.axis.paper_pd())])

    def runs(self, parameters: Parameters) -> list[Followed]:
        """Every plant's run under a law with `parameters`."""
        return [self._run(parameters, i) for i in range(len(self.plants))]

    def cost(self, parameters: Parameters) -> Cost:
        """Errors over all plants, with what limits and lost plants cost."""
        plan, runs = self.axis.plan, self.runs(parameters)
        roughness = _rms([run.roughness_nm for run in runs]) / self.reference_roughness_nm
        if not math.isfinite(roughness):
            return Cost(LOST_MRAD, roughness)
        error = math.hypot(_rms([run.paper_mrad for run in runs]), HELD_WEIGHT * _rms([run.held_mrad for run in runs]))
        restless = max(run.ripple_rad for run in runs) / RIPPLE_LIMIT_RAD
        return Cost(min(error * _penalty(roughness / plan.roughness_limit) * _penalty(restless), LOST_MRAD), roughness)

    def _run(self, parameters: Parameters, index: int) -> Followed:
        plant, (torque, reading), law = self.plants[index], self.noise[index], LAWS[parameters.law]
        run = simulate_closed_loop(
            plant,
            law,
            parameters.pack(),
            self.motion,
            self.axis.plan.loop,
            external_nm=torque,
            reading_rad=reading,
            start=(0.0, 0.0, 0.0),
        )
        if not np.isfinite(run.position_rad).all():
            return Followed(math.inf, math.inf, math.inf, math.inf)
        return self._judge(run.reference_rad - run.encoder_rad, run.torque_nm, run.position_rad)

    def _judge(self, error_rad: Array, torque_nm: Array, position_rad: Array) -> Followed:
        period_s = self.axis.plan.period_s
        start, end = round(SETTLE_S / period_s), round(PAPER_S / period_s)
        hold, late, ripple = (round(t / period_s) for t in (HOLD_S, HELD_FROM_S, RIPPLE_S))
        ends = [len(error_rad) - hold * i for i in range(len(STEPS_MRAD))]
        held = np.concatenate([error_rad[e - hold + late : e] for e in ends])
        return Followed(
            1e3 * float(np.sqrt(np.mean(error_rad[start:end] ** 2))),
            1e3 * float(np.sqrt(np.mean(held**2))),
            float(np.sqrt(np.mean(np.diff(torque_nm[start:end]) ** 2))),
            max(float(np.ptp(position_rad[e - ripple : e])) for e in ends),
        )


def noise_seeds(plan: TuningSettings) -> list[int]:
    """What begins the noise of each plant."""
    return [1000 * plan.seed + i for i in range(plan.plants)]


def with_noise(model: AxisModel, resolution_rad: float) -> AxisModel:
    """`model` with the noise that its identification measured beside the encoder's steps, unless it has its own."""
    return model.model_copy(update={"noise": noise_of(model, resolution_rad)})


def _later(model: AxisModel, extra_s: float) -> AxisModel:
    """`model` with a longer delay from command to torque."""
    return model.model_copy(update={"delay_s": model.delay_s + extra_s})


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(math.fsum(v * v for v in values) / len(values))


def _penalty(share: float) -> float:
    """Factor for a figure over its limit: 1 up to the limit."""
    return 1.0 + PENALTY * max(0.0, share - 1.0)


# --- The optimiser ---------------------------------------------------------------------------------------------------
# The bounded optimiser, the same for every law: even points over the whole range, then a simplex from the best.
# Derivative-free: costs of simulated plants with stiction and encoder steps have no useful slope. Sobol points look for
# a better valley than that of the start, Nelder-Mead (with bounds, adaptive to the dimension) walks down in it. On
# these costs that beat differential evolution by up to 40 % at equal budget, and two descents by 10 %. All numbers are
# shares (0 to 1) of their ranges. Deterministic for a given seed.


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


def minimise(objective: Objective, starts: Sequence[Array], budget: int, seed: int) -> Array:
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


#: The numbers of a set that was tuned, by the names of their ranges.
Values = dict[str, float]


def tune(
    model: AxisModel,
    name: str,
    feedback: Feedback,
    plan: TuningSettings,
    starts: Sequence[Values] = (),
    on_progress: OnShare | None = None,
) -> Tuned:
    """Tune the rival `name` (a key of servod.lab.tune.laws.RIVALS) in one class; the same arguments give the same set.

    `starts` are values that are tried beside the usual start: those of the equal class for the free one, and those of
    its forerunners, make sure that more freedom is never worse. Raises BadInput when the model has no bristle stiffness
    to compensate.
    """
    rival, trial = RIVALS[name], TuningObjective(AxisFacts(model, plan))
    ranges, candidates = rival.space(feedback), candidates_of(rival, feedback, plan)
    done = 0

    def values(shares: Array) -> Values:
        return {**rival.fixed, **{k: r.at(float(s)) for (k, r), s in zip(ranges.items(), shares, strict=True)}}

    def cost(shares: Array) -> float:
        nonlocal done
        done += 1
        if on_progress:
            on_progress(done / candidates)
        return trial.cost(rival.build(trial.axis, values(shares))).value

    best = values(minimise(cost, _shares(ranges, starts), candidates, plan.seed))
    parameters = rival.build(trial.axis, best)
    reached = trial.cost(parameters)
    gains = gain_set(name, rival, feedback, plan, parameters)
    return Tuned(gains, reached.value, done * plan.plants, reached.roughness, best)


def candidates_of(rival: Rival, feedback: Feedback, plan: TuningSettings) -> int:
    """How many sets one search of a rival may try: its part of the law's budget, or one where nothing is tuned."""
    return plan.budget // (plan.plants * rival.searches) if rival.space(feedback) else 1


def _shares(ranges: Mapping[str, Range], starts: Sequence[Values]) -> list[Array]:
    """The usual start and `starts` as shares of the ranges; feedback that a start does not name is the paper's."""
    points = [{key: r.start for key, r in ranges.items()}, *({**PAPER_FEEDBACK, **start} for start in starts)]
    return [np.array([r.share(point[key]) for key, r in ranges.items()]) for point in points]


def as_tuned(model: AxisModel, gains: GainSet, plan: TuningSettings) -> Tuned:
    """A set that came in another way, by the measures of a tuning: its cost and its roughness on the same plants."""
    reached = TuningObjective(AxisFacts(model, plan)).cost(gains.parameters)
    return Tuned(gains, reached.value, plan.plants, reached.roughness, {})


def gain_set(name: str, rival: Rival, feedback: Feedback, plan: TuningSettings, parameters: Parameters) -> GainSet:
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
