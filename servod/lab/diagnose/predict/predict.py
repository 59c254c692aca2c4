"""Compares recordings with a model sample by sample; the mismatch is a torque for each row.

Stands between traces and everything that judges models. The model runs on the recorded command and is pulled to the
encoder by an observer of fixed gains (`innovation_kernel`); the pull, expressed as torque, is the mismatch seen through
a low-pass of the observer's bandwidth. Where a model is right it is noise.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisKind, AxisModel
from servod.kernels.physics.compiled import Kernel, available, compiled
from servod.kernels.physics.layout import PackedPlant, PlantState
from servod.kernels.physics.plant import inputs
from servod.lab.diagnose.data.excited import creeps
from servod.lab.diagnose.data.trace import FASTEST, SHARE_OF_SAMPLING, SLOWEST, Trace, dry_friction
from servod.lab.diagnose.predict.innovation_kernel import innovate
from servod.lab.simulate import open_loop
from servod.lab.simulate.motion import FirstRow
from servod.lab.simulate.replay import Drive

# Runs simulations on both cores: kernels that let go of the interpreter's lock, and threads that call them.
#
# Stands between the predictor and the fit. Threads, not processes: recordings and Jacobians are large and shared.


T = TypeVar("T")
R = TypeVar("R")

#: Cores that a diagnosis uses, at most.
MOST_CORES = 2


@cache
def released(function: Kernel) -> Kernel:
    """`function` compiled, and called without the interpreter's lock; in pure Python where there is no compiler."""
    if not available():
        return function
    import numba

    kernel = compiled(function)

    def call(p: Any, tables: Any, s: Any, *rest: Any) -> None:
        kernel(p[0], tables, s[0], *rest)

    outer: Kernel = numba.njit(nogil=True)(call)
    return outer


@cache
def cores() -> int:
    """Cores that this process may use, MOST_CORES at most; SERVOD_CORES overrides."""
    asked = os.environ.get("SERVOD_CORES", "")
    return int(asked) if asked.isdigit() and int(asked) > 0 else min(MOST_CORES, len(os.sched_getaffinity(0)))


@cache
def _pool(level: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=cores(), thread_name_prefix=level)


def side_by_side(level: str, function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` of every item, in order. Calls within calls need another `level`, lest they wait for each other."""
    if cores() == 1:
        return [function(item) for item in items]
    return list(_pool(level).map(function, items))


Array = NDArray[np.float64]


#: The share of the sampling rate where the axis creeps: a slower observer carries a model along that sticks and slips.
SHARE_CREEPING = 0.35

#: Share of dry friction that encoder noise may make of the mismatch; sets the bandwidth.
WANTED_NOISE = 0.006

#: Damping of the observer's poles.
POLES_DAMPING = 0.8

#: Longest step of the model, s; and the factor on the number of steps for reversals and for a gap.
LONGEST_STEP_S = 0.0013
STEPS_AT_REVERSAL, STEPS_IN_GAP = 4, 2

#: Share of the motor's correction that the load gets: all behind a gap, less behind a spring, which it would ring.
LOAD_SHARE, LOAD_SHARE_IN_GAP = 0.6, 1.0

#: Innovations below this many noises of the encoder carry the model's friction nowhere.
QUIET = 5.0

#: Bandwidths (time constants of the observer) that pass before a row behind a start counts.
SETTLING = 30.0

#: Mismatches beyond this many dry frictions say no more: a model that has run away counts as that bad.
WORST = 1e6


@dataclass(frozen=True, slots=True)
class Observer:
    """Fixed gains for a trace: one row each; `to_torque` turns an innovation into torque."""

    bandwidth: float
    position_gain: Array
    velocity_gain: Array
    to_torque: Array
    steps: NDArray[np.int64]


def bandwidth(inertia: float, dry: float, traces: Sequence[Trace]) -> float:
    """Observer bandwidth in rad/s for an axis of this inertia and dry friction: as fast as the encoder noise allows."""
    noise = max(trace.position_noise for trace in traces)
    period = max(trace.period_s for trace in traces)
    allowed = math.sqrt(WANTED_NOISE * dry / (inertia * noise)) if noise > 0.0 else FASTEST
    allowed *= math.sqrt(1.0 / math.sqrt(allowed * period))  # a slow observer averages over more rows
    share = SHARE_CREEPING if creeps(traces, inertia) else SHARE_OF_SAMPLING
    return min(max(allowed, SLOWEST), FASTEST, share / period)


def observer(trace: Trace, inertia: float, rate: float) -> Observer:
    """Gains that put both poles of the correction at `rate` rad/s, for each row's own step."""
    t_s = trace.drive.t_s
    step = np.append(np.diff(t_s), trace.period_s)
    step = np.clip(step, 1e-6, 3.0 * trace.period_s)
    decay = np.exp(-POLES_DAMPING * rate * step)
    turn = np.cos(rate * step * math.sqrt(1.0 - POLES_DAMPING**2))
    velocity_gain = (1.0 - 2.0 * decay * turn + decay**2) / step
    return Observer(rate, 1.0 - decay**2, velocity_gain, inertia * velocity_gain / step, _steps(trace, step))


def _steps(trace: Trace, step: Array) -> NDArray[np.int64]:
    """Inner steps of each row: more around reversals, where friction turns over within a sample or two."""
    base = np.ceil(step / LONGEST_STEP_S).astype(np.int64)
    slow = np.abs(trace.velocity) < 2.5 * np.abs(trace.acceleration) * step
    return np.where(slow, np.maximum(base, STEPS_AT_REVERSAL), base)


class Predictor:
    """Mismatch of any model with fixed recordings; the scale of torque is that of the nominal model."""

    def __init__(self, traces: Sequence[Trace], nominal: AxisModel, rate: float | None = None) -> None:
        self.traces = tuple(traces)
        self.dry = dry_friction(nominal)
        self.linear = nominal.axis is AxisKind.LINEAR
        self.rate = bandwidth(nominal.inertia, self.dry, traces) if rate is None else rate
        self.observers = tuple(observer(trace, nominal.inertia, self.rate) for trace in self.traces)
        ends = np.cumsum([len(trace.drive.t_s) for trace in self.traces])
        self.slices = tuple(slice(int(a), int(b)) for a, b in zip([0, *ends[:-1]], ends, strict=True))
        self.counts = np.concatenate([self._counting(trace) for trace in self.traces])
        self.evaluations = 0
        self._run, self._follow = released(innovate), released(open_loop.follow)

    def _counting(self, trace: Trace) -> NDArray[np.bool_]:
        """Rows that count: those of the trace, once the observer has settled behind each start."""
        counts = trace.counts.copy()
        for row in trace.starts:
            begun = trace.drive.t_s[row]
            counts &= ~((trace.drive.t_s >= begun) & (trace.drive.t_s < begun + SETTLING / self.rate))
        return counts

    def over(self, name: str) -> Array:
        """A column of `Drive` or `Trace` over the rows of all traces."""
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
        packed = [model.pack() for model in models]
        each = packed if len(packed) > 1 else packed * len(self.traces)
        self.evaluations += 1
        parts = [self._one(*one) for one in zip(each, self.traces, self.observers, strict=True)]
        limit = WORST * self.dry
        clean = np.nan_to_num(np.concatenate(parts), nan=limit, posinf=limit, neginf=-limit)
        return np.where(self.counts, np.clip(clean, -limit, limit), 0.0)

    def _one(self, packed: PackedPlant, trace: Trace, seen: Observer) -> Array:
        drive = trace.drive
        gap, first = packed.p.gap > 0.0, trace.first(packed.p.delay_s)
        axis = inputs(packed, PlantState(temperature_c=packed.p.start_c, first_s=trace.begun_s))
        states = np.array([self._start(packed, trace, int(row), first) for row in trace.starts])
        out = np.zeros(len(drive.t_s))
        steps = seen.steps * STEPS_IN_GAP if gap else seen.steps
        held = drive.t_s, drive.torque, first.command_before, drive.temperature_c, drive.position
        share = LOAD_SHARE_IN_GAP if gap else LOAD_SHARE
        gains = steps, seen.position_gain, seen.velocity_gain, share, QUIET * trace.position_noise
        self._run(*axis, *held, *gains, trace.starts, states, out)
        return seen.to_torque * out

    def _start(self, packed: PackedPlant, trace: Trace, row: int, known: FirstRow) -> Array:
        """Position, velocity and hidden states in balance with the recorded motion of one row."""
        drive = trace.drive
        motion = known.motion if row == 0 else tuple(drive.motion[row, :3])
        before = known.command_before if row == 0 else float(drive.torque[row - 1])
        hidden = np.zeros((1, 4))
        axis = inputs(packed, PlantState(temperature_c=packed.p.start_c))
        one = slice(row, row + 1)
        moved = np.array([motion])
        self._follow(*axis, drive.t_s[one], moved, drive.torque[one], before, drive.temperature_c[one], hidden, 1e-3)
        return np.array([motion[0], motion[1], *hidden[0]])


# A shorter set of data for first rounds: of every recording the stretch where most is left to explain.
#
# Stands between the predictor and the trials; what is tried on it and promises anything is fitted on everything after.


#: Share of each recording that is kept, and the least that is, s.
KEPT, LEAST_S = 0.35, 4.0


def shortened(predictor: Predictor, nominal: AxisModel, mismatch: Array) -> Predictor:
    """A predictor on the stretch of each recording with the greatest power of `mismatch`; the same observer."""
    traces = [
        _cut(trace, mismatch[part], SETTLING / predictor.rate)
        for trace, part in zip(predictor.traces, predictor.slices, strict=True)
    ]
    return Predictor(traces, nominal, predictor.rate)


def _cut(trace: Trace, mismatch: Array, settling_s: float) -> Trace:
    length = max(KEPT * trace.duration_s, LEAST_S) + settling_s
    rows = min(round(length / trace.period_s), len(mismatch))
    power = np.concatenate([[0.0], np.cumsum(mismatch**2)])
    first = int(np.argmax(power[rows:] - power[: len(power) - rows]))
    part = slice(first, first + rows)
    drive = trace.drive
    short = Drive(drive.t_s[part], drive.torque[part], drive.position[part], drive.temperature_c[part])
    return replace(trace, drive=short, counts=trace.counts[part])
