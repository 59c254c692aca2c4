"""What one gain set costs on the plants of a tuning: the same motion, plants, noise and rules for every law.

Stands on the compiled simulator. Cost in mrad: the RMS error on (19), with the error of held steps beside it, times
what the set pays for rough torque, for restlessness and for plants that run away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from servod.formats.gains.parameters import Parameters
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import LAWS
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import simulate_closed_loop
from servod.lab.synthesize.regions import uncertainty_of
from servod.lab.tracking.metrics import SETTLE_S, STEPS_MRAD, Array, paper_rows
from servod.lab.tune.laws import Axis
from servod.lab.tune.plan import TunePlan
from servod.lab.verify.plants import drawn
from servod.lab.verify.trials import RIPPLE_LIMIT_RAD

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
class Trial:
    """The plants of one tuning and the motion; judges gain sets by their law and packed parameters."""

    axis: Axis

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
        return Cost(min(error * _beyond(roughness / plan.roughness_limit) * _beyond(restless), LOST_MRAD), roughness)

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


def noise_seeds(plan: TunePlan) -> list[int]:
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


def _beyond(share: float) -> float:
    """Factor for a figure over its limit: 1 up to the limit."""
    return 1.0 + PENALTY * max(0.0, share - 1.0)
