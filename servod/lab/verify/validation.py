"""The validation motion of a deployment, and what is read from it: short, of small travel, the same before and after.

Under the promise (which simulates it) and under servod.lab.deploy (which runs it). A slow sine passes through the fall
of the Stribeck curve, a brisk one shows inertia and delay, a small step and back shows how the joint is held.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Promise
from servod.formats.model.axis_model import AxisModel
from servod.kernels.motions import table
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.verify.plants import drawn
from servod.lab.verify.trials import scale_of

Array = NDArray[np.float64]


class Part(StrEnum):
    """What of the motion a figure belongs to."""

    SLOW = "slow"
    BRISK = "brisk"
    HOLD = "hold"


PART_TEXT: Mapping[Part, str] = {
    Part.SLOW: "RMS error on the slow sine",
    Part.BRISK: "RMS error on the brisk sine",
    Part.HOLD: "swing while it holds after a step",
}

#: Peak speeds of the sines, as shares of the speed that the set was designed for.
SLOW_SHARE, BRISK_SHARE = 0.126, 0.5
SLOW_HZ, SLOW_PERIODS = 0.5, 4
#: The brisk sine is as fast as the cycle can sample well: this many cycles to a period, at most so many Hz.
BRISK_HZ, BRISK_CYCLES, BRISK_PERIODS = 12.5, 60, 16
REST_S, STEP_S = 0.5, 1.0
#: A sine swells from nothing before its periods and fades behind them, in this time: a jump of the velocity would ask
#: a stiff law for more than the torque limits give.
SWELL_S = 0.25
#: Periods at the start of each sine that are not judged: the law settles.
SLOW_SKIPPED, BRISK_SKIPPED = 1, 4
STEP_SHARE = 0.05  # of the slow sine's amplitude: a stiff law answers a larger step with its whole torque
#: What is held is judged from here after the step on.
HOLD_FROM_S = 0.5


@dataclass(frozen=True)
class ValidationMotion:
    """Amplitudes in rad, frequencies in Hz; everything returns to where it began."""

    period_s: float
    slow_rad: float
    brisk_rad: float
    brisk_hz: float
    step_rad: float

    @property
    def travel_rad(self) -> float:
        """The reference goes so far to either side at most."""
        return max(self.slow_rad, self.brisk_rad, self.step_rad)

    @property
    def duration_s(self) -> float:
        """The whole motion."""
        return len(self.sines) * self.period_s + 2.0 * STEP_S

    @property
    def sines(self) -> Array:
        """Positions of the first half, one for each cycle: rest, slow sine, rest, brisk sine, rest."""
        rest = np.zeros(self._count(REST_S))
        slow = self._sine(self.slow_rad, SLOW_HZ, SLOW_PERIODS)
        brisk = self._sine(self.brisk_rad, self.brisk_hz, BRISK_PERIODS)
        return np.concatenate([rest, slow, rest, brisk, rest])

    def rows(self) -> Array:
        """The whole motion for the simulator (position, velocity, acceleration), as the loop makes it of a table."""
        positions = self.sines.tolist()
        path = table(positions, len(positions), self.period_s)
        sines = [path(k * self.period_s) for k in range(1, len(positions))]
        hold = np.zeros((self._count(STEP_S), 3))
        up = hold + np.array([self.step_rad, 0.0, 0.0])
        return np.concatenate([np.array(sines), up, hold])

    def figures(self, sine_error_rad: Array, held_rad: Sequence[Array]) -> Figures:
        """Figures of a run: errors along `sines`, and the positions after each step from its first cycle on.

        Raises ValueError when a part is too short.
        """
        slow_start, swell = self._count(REST_S) + self._count(SWELL_S), self._count(SWELL_S)
        slow = self._periods(sine_error_rad, slow_start, SLOW_HZ, SLOW_PERIODS)[SLOW_SKIPPED:]
        brisk_start = 2 * slow_start + self._count(SLOW_PERIODS / SLOW_HZ) + swell
        brisk = self._periods(sine_error_rad, brisk_start, self.brisk_hz, BRISK_PERIODS)[BRISK_SKIPPED:]
        hold = [float(np.ptp(held[self._count(HOLD_FROM_S) :])) for held in held_rad]
        return Figures({Part.SLOW: tuple(slow), Part.BRISK: tuple(brisk), Part.HOLD: tuple(hold)})

    def _periods(self, error_rad: Array, start: int, frequency_hz: float, periods: int) -> list[float]:
        """RMS of each period."""
        length = self._count(1.0 / frequency_hz)
        parts = [error_rad[start + i * length : start + (i + 1) * length] for i in range(periods)]
        if any(len(part) < length - 1 for part in parts):
            raise ValueError("the motion was not run to its end")
        return [float(np.sqrt(np.mean(part**2))) for part in parts]

    def _sine(self, amplitude_rad: float, frequency_hz: float, periods: int) -> Array:
        """So many periods, with their swelling before and their fading behind."""
        swell, cycles = self._count(SWELL_S), self._count(periods / frequency_hz)
        k = np.arange(1 - swell, cycles + swell + 1, dtype=np.float64)
        inside = np.clip(np.minimum(k + swell, cycles + swell - k) / swell, 0.0, 1.0)
        envelope = 0.5 - 0.5 * np.cos(math.pi * inside)
        wave: Array = amplitude_rad * envelope * np.sin(2.0 * math.pi * frequency_hz * self.period_s * k)
        return wave

    def _count(self, duration_s: float) -> int:
        return round(duration_s / self.period_s)


@dataclass(frozen=True)
class Figures:
    """One figure for each period of a sine (RMS) and for each hold (peak to peak), in rad."""

    of: Mapping[Part, tuple[float, ...]]

    def mean(self, part: Part) -> float:
        """Mean over the periods."""
        return float(np.mean(self.of[part]))

    def standard_error(self, part: Part) -> float:
        """What the mean may be off by chance, from the scatter over the periods."""
        values = self.of[part]
        return float(np.std(values, ddof=1) / math.sqrt(len(values)))

    def document(self) -> dict[str, float]:
        """Mean of each part in mrad, by names that say so."""
        return {f"{part.value}_mrad": 1e3 * self.mean(part) for part in Part}


def motion_for(design: Design) -> ValidationMotion:
    """The validation motion of a set, by the speed that it was designed for and its cycle."""
    brisk_hz = min(BRISK_HZ, 1.0 / (BRISK_CYCLES * design.period_s))
    slow_rad = SLOW_SHARE * design.speed_max_rad_s / (2.0 * math.pi * SLOW_HZ)
    return ValidationMotion(
        period_s=design.period_s,
        slow_rad=slow_rad,
        brisk_rad=BRISK_SHARE * design.speed_max_rad_s / (2.0 * math.pi * brisk_hz),
        brisk_hz=brisk_hz,
        step_rad=STEP_SHARE * slow_rad,
    )


# --- The promise -----------------------------------------------------------------------------------------------------
# What a certificate promises of the validation motion: the worst that drawn plants show, which a deployment measures. A
# promise is kept on the axis, not here.


PLANTS = 24


def promise(gains: GainSet, design: Design, seed: int) -> Promise | None:
    """Worst figures over the model and PLANTS plants of the intervals; None where one does not get through."""
    motion = motion_for(design)
    resolution_rad = 2.0 * np.pi / design.counts_per_turn if design.counts_per_turn else 0.0
    rows, noise = motion.rows(), noise_of(design.model, resolution_rad)
    plants = [design.model, *(drawn(design.model, design.uncertainty, seed, i) for i in range(PLANTS))]
    runs = [simulated(gains, design, plant.model_copy(update={"noise": noise}), motion, rows) for plant in plants]
    worst = {part: max(figures.mean(part) for figures in runs) for part in Part}
    if not np.isfinite(list(worst.values())).all():
        return None
    return Promise(
        slow_rad=worst[Part.SLOW], brisk_rad=worst[Part.BRISK], hold_rad=worst[Part.HOLD], plants=len(plants)
    )


def simulated(
    gains: GainSet, design: Design, plant: AxisModel, motion: ValidationMotion, rows: Array, seed: int = 0
) -> Figures:
    """Figures of `plant` under `gains` along the validation motion (`rows` of it), as the encoder shows them."""
    rest = np.zeros((round(0.1 / design.period_s), 3))
    torque, reading = noise_series(plant.noise, len(rest) + len(rows), design.period_s, seed)
    run = simulate_closed_loop(
        plant,
        gains.law,
        gains.pack(),
        np.concatenate([rest, rows]),
        LoopSettings(design.period_s, design.counts_per_turn, design.velocity_cutoff_hz, scale_of(design).torque_nm),
        external_nm=torque,
        reading_rad=reading,
    )
    position = run.encoder_rad[len(rest) :]
    steps = round(STEP_S / design.period_s)
    sines = len(rows) - 2 * steps
    return motion.figures(rows[:sines, 0] - position[:sines], (position[sines : sines + steps], position[-steps:]))
