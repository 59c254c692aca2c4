"""Compares recordings with a model sample by sample; the mismatch is a torque for each row.

Stands between traces and everything that judges models. The model runs on the recorded command and is pulled to the
encoder by an observer of fixed gains (`innovation_kernel`); the pull, expressed as torque, is the mismatch seen through
a low-pass of the observer's bandwidth. Where a model is right it is noise.

The torque is that of the command which would close the gap: the pull times the model's own mass, over what the model
makes of a command. With one mass for all models a trial model k times heavier would shrink every torque that it leaves
out by k, and mass, gain, saturation and friction of the command would explain anything (the least squares of motion on
command in place of that of command on motion, which feedback makes biased: Ljung, System Identification, 1999, 13.4).
A model that is lighter for what it makes of a command is told with the nominal ratio: its own would make the encoder's
noise small instead. Mass and torque that grow together change neither: no recording tells their common factor. The same
holds of a drive whose torque is fitted: half the torque of a duty would halve all that a model leaves out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from servod.common.portable import usable_cores
from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.kernels.physics.compiled import Kernel, available, entry_without_lock
from servod.kernels.physics.friction import directed_curve
from servod.kernels.physics.layout import PackedPlant, PlantParameters, PlantState
from servod.kernels.physics.plant import inputs
from servod.lab.diagnose.data.excitation import creeps
from servod.lab.diagnose.data.trace import CheckedTrace, dry_friction
from servod.lab.diagnose.predict.innovation_kernel import innovate
from servod.lab.diagnose.settings import SETTINGS
from servod.lab.simulate import open_loop
from servod.lab.simulate.motion import FirstRow
from servod.lab.simulate.replay import Drive, driven

# --- Threads ---------------------------------------------------------------------------------------------------------
# Runs simulations on both cores: kernels that let go of the interpreter's lock, and threads that call them. Threads,
# not processes: recordings and Jacobians are large and shared.


T = TypeVar("T")
R = TypeVar("R")


@cache
def without_lock(function: Kernel) -> Kernel:
    """`function` compiled, and called without the interpreter's lock; in pure Python where there is no compiler."""
    return entry_without_lock(function) if available() else function


@cache
def cores() -> int:
    """Cores that this process may use, within the settings; SERVOD_CORES overrides."""
    asked = os.environ.get("SERVOD_CORES", "")
    most = SETTINGS.observer.most_cores
    return int(asked) if asked.isdigit() and int(asked) > 0 else min(most, usable_cores())


@cache
def _pool(level: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=cores(), thread_name_prefix=level)


def in_parallel(level: str, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` of every item, in order. Calls within calls need another `level`, lest they wait for each other."""
    if cores() == 1:
        return [function(item) for item in items]
    return list(_pool(level).map(function, items))


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Observer:
    """Fixed gains for a trace: one row each; `to_torque` turns an innovation into torque of the nominal mass."""

    bandwidth: float
    position_gain: Array
    velocity_gain: Array
    to_torque: Array
    steps: NDArray[np.int64]


#: Ratio of the two speeds of a chord.
CHORD = 1.5


def bandwidth(inertia: float, dry: float, traces: Sequence[CheckedTrace], growth: float = 0.0) -> float:
    """Observer bandwidth in rad/s for an axis of this inertia and dry friction: as fast as the encoder noise allows.

    Where sampling and noise let it, fast enough for a model whose errors of velocity grow with `growth` rad/s: its
    damping 2*zeta*rate must be more than that, else what is left is chance.
    """
    noise = max(trace.position_noise for trace in traces)
    period = max(trace.period_s for trace in traces)
    allowed = (
        math.sqrt(SETTINGS.observer.wanted_noise * dry / (inertia * noise))
        if noise > 0.0
        else SETTINGS.observer.fastest
    )
    allowed *= math.sqrt(1.0 / math.sqrt(allowed * period))  # a slow observer averages over more rows
    share = SETTINGS.observer.share_creeping if creeps(traces, inertia) else SETTINGS.observer.share_of_sampling
    rare = min(SETTINGS.observer.most_of_sampling / period, SETTINGS.observer.slow_sampling)
    usual = min(max(allowed, SETTINGS.observer.slowest), SETTINGS.observer.fastest, max(share / period, rare))
    holds = SETTINGS.observer.over_growth * growth / (2.0 * SETTINGS.observer.poles_damping)
    held = min(holds, max(allowed, SETTINGS.observer.slowest), SETTINGS.observer.share_creeping / period)
    return max(usual, held, _swift_bandwidth(inertia, usual, traces))


def growth_rate(model: AxisModel, traces: Sequence[CheckedTrace]) -> float:
    """Rate in rad/s with which an error of velocity grows where the model's steady friction falls; 0 where it does not.

    The steepest chord over speeds that the recordings go through: noise of a measured map makes any slope between two
    nodes.
    """
    packed = model.pack()
    top = max(float(np.max(np.abs(trace.velocity[trace.counts]), initial=1e-9)) for trace in traces)
    steepest = 0.0
    for speed in top * np.geomspace(1e-3, 1.0 / CHORD, 60):
        for side in (-1.0, 1.0):
            slow, fast = (directed_curve(*packed, side * v) for v in (speed, CHORD * speed))
            viscous = packed.p.viscous * (packed.p.positive_viscous if side > 0.0 else packed.p.negative_viscous)
            steepest = max(steepest, (slow - fast) / ((CHORD - 1.0) * float(speed)) - viscous)
    return steepest / model.inertia


def _swift_bandwidth(inertia: float, usual: float, traces: Sequence[CheckedTrace]) -> float:
    """Bandwidth that a command asks for most of whose power lies beyond the usual one, rad/s; 0 where none does.

    What drives such an axis (cogging of a motor with many poles that turns) is hidden by a slower observer's low-pass,
    and what is left is taken for a bent friction curve. Encoder noise may make a share of that command then.
    """
    asked, size = (min(of(trace.drive) for trace in traces) for of in (middle_frequency, command_rms))
    noise = inertia * max(trace.position_noise for trace in traces)
    if asked <= usual or noise <= 0.0:
        return 0.0
    allowed = math.sqrt(SETTINGS.observer.swift_noise * size / noise)
    return min(asked, allowed, SETTINGS.observer.share_creeping / max(trace.period_s for trace in traces))


def middle_frequency(drive: Drive) -> float:
    """The frequency that half of the power of the command's changes lies below, rad/s."""
    power = np.abs(np.fft.rfft(drive.torque - float(np.mean(drive.torque)))) ** 2
    total = np.cumsum(power)
    if total[-1] <= 0.0:
        return 0.0
    line = int(np.searchsorted(total, 0.5 * total[-1]))
    return 2.0 * math.pi * line / (len(drive.torque) * drive.period_s)


def command_rms(drive: Drive) -> float:
    """Root mean square of the command's changes, N*m or N."""
    return float(np.std(drive.torque))


def observer(trace: CheckedTrace, inertia: float, rate: float, longest_s: float) -> Observer:
    """Gains that put both poles of the correction at `rate` rad/s, for each row's own step."""
    t_s = trace.drive.t_s
    step = np.append(np.diff(t_s), trace.period_s)
    step = np.clip(step, 1e-6, 3.0 * trace.period_s)
    decay = np.exp(-SETTINGS.observer.poles_damping * rate * step)
    turn = np.cos(rate * step * math.sqrt(1.0 - SETTINGS.observer.poles_damping**2))
    velocity_gain = (1.0 - 2.0 * decay * turn + decay**2) / step
    return Observer(rate, 1.0 - decay**2, velocity_gain, inertia * velocity_gain / step, _steps(trace, step, longest_s))


def starts_behind_gaps(trace: CheckedTrace, rate: float) -> NDArray[np.int64]:
    """Rows where the observer begins again: the trace's own starts, and rows behind gaps too long for the observer.

    Nobody knows the command in a gap. What it did there shows as torque that the axis lacks for as long as the observer
    remembers; so a gap of some of its time constants hides what a longer one would.
    """
    step = np.diff(trace.drive.t_s)
    lost = max(SETTINGS.observer.gap_constants / rate, SETTINGS.observer.gap_rows * trace.period_s)
    return np.unique(np.concatenate([trace.starts, np.flatnonzero(step > lost) + 1])).astype(np.int64)


def _steps(trace: CheckedTrace, step: Array, longest_s: float) -> NDArray[np.int64]:
    """Inner steps of each row: more around reversals, where friction turns over within a sample or two."""
    base = np.ceil(step / longest_s).astype(np.int64)
    slow = np.abs(trace.velocity) < 2.5 * np.abs(trace.acceleration) * step
    return np.where(slow, np.maximum(base, SETTINGS.observer.steps_at_reversal), base)


#: In a step of what is told the model's fastest mode makes so much of a turn, rad; the shortest step is this long, s.
FINE_TURN_RAD, FINEST_STEP_S = 0.2, 2.5e-4


def fine_step_s(model: AxisModel) -> float:
    """Step that the fastest mode of a model asks for, of bristle or spring on the motor alone, s; within limits."""
    p = model.pack().p
    squared = (p.sigma0 + p.stiffness) / p.inertia
    if p.load_inertia > 0.0:
        squared += p.stiffness / p.load_inertia
    turn = FINE_TURN_RAD / math.sqrt(max(squared, 1e-30))
    return min(max(turn, FINEST_STEP_S), SETTINGS.observer.longest_step_s)


class Predictor:
    """Mismatch of any model with fixed recordings, as the command that would close the gap.

    Models are simulated in steps of `longest_step_s` at most.
    """

    def __init__(
        self,
        traces: Sequence[CheckedTrace],
        nominal: AxisModel,
        rate: float | None = None,
        longest_step_s: float = SETTINGS.observer.longest_step_s,
    ) -> None:
        self.traces = tuple(traces)
        self.dry = dry_friction(nominal)
        self.inertia = nominal.inertia
        self.drive_torque = drive_factor(nominal)
        self.linear = nominal.axis is AxisKind.LINEAR
        self.rate = bandwidth(nominal.inertia, self.dry, traces, growth_rate(nominal, traces)) if rate is None else rate
        self.longest_step_s = longest_step_s
        self.observers = tuple(observer(trace, nominal.inertia, self.rate, longest_step_s) for trace in self.traces)
        ends = np.cumsum([len(trace.drive.t_s) for trace in self.traces])
        self.slices = tuple(slice(int(a), int(b)) for a, b in zip([0, *ends[:-1]], ends, strict=True))
        self.starts = tuple(starts_behind_gaps(trace, self.rate) for trace in self.traces)
        self.counts = np.concatenate([self._rows_that_count(i) for i in range(len(self.traces))])
        self.evaluations = 0
        self._run, self._follow = without_lock(innovate), without_lock(open_loop.follow)
        self._behind = without_lock(open_loop.recorded_motion)

    def _rows_that_count(self, index: int) -> NDArray[np.bool_]:
        """Rows that count: those of the trace, once the observer has settled behind each start."""
        trace = self.traces[index]
        counts = trace.counts.copy()
        for row in self.starts[index]:
            begun = trace.drive.t_s[row]
            counts &= ~((trace.drive.t_s >= begun) & (trace.drive.t_s < begun + SETTINGS.observer.settling / self.rate))
        return counts

    def over(self, name: str) -> Array:
        """A column of `Drive` or `CheckedTrace` over the rows of all traces."""
        return np.concatenate(
            [np.asarray(getattr(trace, name, getattr(trace.drive, name, None))) for trace in self.traces]
        )

    @cached_property
    def encoder_noise(self) -> float:
        """Mismatch that the encoder's noise and steps alone make in a row of the noisiest trace, N*m or N."""
        return max(
            float(np.median(seen.to_torque)) * trace.position_noise
            for seen, trace in zip(self.observers, self.traces, strict=True)
        )

    def mismatch(self, *models: AxisModel) -> Array:
        """Torque mismatch of every row of all traces, N*m or N; 0 in rows that do not count.

        One model for all traces, or one for each.
        """
        of_each = [(model, model.pack()) for model in models]
        each = of_each if len(models) > 1 else of_each * len(self.traces)
        self.evaluations += 1
        parts = [
            self._trace_mismatch(*driven(model, trace.drive, packed), index, drive_factor(model) / self.drive_torque)
            for index, ((model, packed), trace) in enumerate(zip(each, self.traces, strict=True))
        ]
        limit = SETTINGS.observer.worst * self.dry
        clean = np.nan_to_num(np.concatenate(parts), nan=limit, posinf=limit, neginf=-limit)
        return np.where(self.counts, np.clip(clean, -limit, limit), 0.0)

    def _trace_mismatch(self, packed: PackedPlant, drive: Drive, index: int, stronger: float) -> Array:
        """Of one trace; `stronger`: torque of a duty, volt or ampere over that of the nominal drive."""
        trace, seen, starts = self.traces[index], self.observers[index], self.starts[index]
        gap, first = packed.p.gap > 0.0, trace.first_row(packed.p.delay_s)
        axis = inputs(packed, PlantState(temperature_c=packed.p.start_c, first_s=trace.begun_s))
        states = np.array([self._start(packed, drive, int(row), first) for row in starts])
        out = np.zeros(len(drive.t_s))
        steps = seen.steps * SETTINGS.observer.steps_in_gap if gap else seen.steps
        held = drive.t_s, drive.torque, first.command_before, drive.temperature_c, drive.position
        share = SETTINGS.observer.load_share_in_gap if gap else SETTINGS.observer.load_share
        gains = (
            steps,
            seen.position_gain,
            seen.velocity_gain,
            share,
            SETTINGS.observer.quiet_noises * trace.position_noise,
        )
        self._run(*axis, *held, *gains, starts, states, out)
        heavier = (packed.p.inertia + packed.p.load_inertia) / self.inertia
        counted = heavier / (torque_per_command(packed.p, trace) * stronger)
        return seen.to_torque * max(counted, 1.0) * out

    def _start(self, packed: PackedPlant, drive: Drive, row: int, known: FirstRow) -> Array:
        """Position, velocity and hidden states in balance with the recorded motion of one row."""
        motion = known.motion if row == 0 else tuple(drive.motion[row, :3])
        before = known.command_before if row == 0 else float(drive.torque[row - 1])
        hidden = np.zeros((1, 4))
        axis = inputs(packed, PlantState(temperature_c=packed.p.start_c))
        one = slice(row, row + 1)
        moved = np.array([motion])
        if packed.p.eccentricity_n > 0:  # else the observer's first correction drags the bristle along
            self._behind(*axis, moved)
        self._follow(*axis, drive.t_s[one], moved, drive.torque[one], before, drive.temperature_c[one], hidden, 1e-3)
        return np.array([*moved[0, :2], *hidden[0]])


def drive_factor(model: AxisModel) -> float:
    """Torque that the drive of a model makes of a command of one; 1 where the command is a torque."""
    factor = model.drive.factor if model.drive is not None else None
    return factor if factor is not None else 1.0


#: The least that a model may make of a command, as a share of it: one that makes nothing would be off by anything.
LEAST_TORQUE = 0.02


def torque_per_command(p: PlantParameters, trace: CheckedTrace) -> float:
    """What a model makes of the recorded command, by least squares: its gain, limit and friction of the command."""
    if not p.complex and p.friction_per_command == 0.0:
        return 1.0
    command = trace.drive.torque
    made = command
    if p.complex:
        made = np.where(command >= 0.0, p.gain_positive, p.gain_negative) * command
        if p.limit_positive > 0.0:
            limit = np.where(made >= 0.0, p.limit_positive, p.limit_negative)
            made = limit * np.tanh(made / limit) if p.limit_soft else np.clip(made, -limit, limit)
    made = made - p.friction_per_command * np.abs(made) * np.sign(trace.velocity)
    power = float(command @ command)
    return max(float(made @ command) / power, LEAST_TORQUE) if power > 0.0 else 1.0


# --- Shorter data ----------------------------------------------------------------------------------------------------
# A shorter set of data for first rounds: of every recording the stretch where most is left to explain. What is tried on
# it and promises anything is fitted on everything after.


def shorten(predictor: Predictor, nominal: AxisModel, mismatch: Array) -> Predictor:
    """A predictor on the stretch of each recording with the greatest power of `mismatch`; the same observer."""
    traces = [
        _cut(trace, mismatch[part], SETTINGS.observer.settling / predictor.rate)
        for trace, part in zip(predictor.traces, predictor.slices, strict=True)
    ]
    return Predictor(traces, nominal, predictor.rate)


def _cut(trace: CheckedTrace, mismatch: Array, settling_s: float) -> CheckedTrace:
    length = max(SETTINGS.observer.shortened_share * trace.duration_s, SETTINGS.observer.shortened_least_s) + settling_s
    rows = min(round(length / trace.period_s), len(mismatch))
    power = np.concatenate([[0.0], np.cumsum(mismatch**2)])
    first = int(np.argmax(power[rows:] - power[: len(power) - rows]))
    part = slice(first, first + rows)
    return replace(trace, drive=trace.drive.part(part), counts=trace.counts[part])
