"""Closed-loop simulator: an axis model under any control law, hundreds to thousands of times faster than real time.

Used by synthesis, verification, demo reports and tests; off the control path. The law is the function that the loop
calls, the physics is the one of the virtual plant; both compiled here (numpy and numba: the `lab` extra).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.kernels.physics.compiled import Kernel, available, bound, compiled
from servod.kernels.physics.layout import S_BRISTLE, S_LOAD_POSITION, S_LOAD_VELOCITY, S_POSITION, S_VELOCITY
from servod.kernels.physics.plant import INNER_STEP_S, rest_state
from servod.lab.simulate import closed_loop

Array = NDArray[np.float64]

#: Room for a law's state, which no law fills.
LAW_STATES = 16


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """What stands around the law: sample time, encoder, velocity filter and the last limit."""

    period_s: float = 0.001
    counts_per_turn: float = 2.0**20  # 0 = no steps
    velocity_cutoff_hz: float = 120.0
    torque_limit_nm: float = math.inf
    delay_s: float | None = None  # None = the model's
    inner_step_s: float = INNER_STEP_S

    @property
    def resolution_rad(self) -> float:
        """Angle of one count; 0 for an encoder without steps."""
        return 2.0 * math.pi / self.counts_per_turn if self.counts_per_turn else 0.0


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """One simulated motion, a value for each sample; torques in N*m, positions in rad.

    `position_rad` is the true joint (load) position, `encoder_rad` what the law saw, `velocity_rad_s` the filtered
    velocity that it saw. `state` is the plant's at the end (`servod.kernels.physics.layout`).
    """

    t_s: Array
    reference_rad: Array
    position_rad: Array
    encoder_rad: Array
    velocity_rad_s: Array
    true_velocity_rad_s: Array
    torque_nm: Array
    feedback_nm: Array
    friction_nm: Array
    other_nm: Array
    state: Array

    def tracking_error_rad(self, after_s: float = 0.0) -> Array:
        """Reference minus true position, from `after_s` on."""
        return (self.reference_rad - self.position_rad)[self.t_s >= after_s]


def simulate_closed_loop(
    model: AxisModel,
    law: Kernel,
    gains: Sequence[float],
    reference: Array,
    settings: LoopSettings | None = None,
    *,
    external_nm: Array | None = None,
    reading_rad: Array | None = None,
    start: tuple[float, float, float] | None = None,
) -> ClosedLoopRun:
    """Run `model` under `law` along `reference` (rows of position, velocity, acceleration, one for each sample).

    `law` is a step function of `servod.kernels.laws`; `gains` its flat parameters. `external_nm` acts beside the
    command, `reading_rad` is the error of each encoder reading; `start` is (position, velocity, bristle deflection), by
    default at rest on the reference's first position.
    """
    settings = settings or LoopSettings()
    reference = np.ascontiguousarray(reference, dtype=np.float64)
    disturbed = _samples(external_nm, len(reference)), _samples(reading_rad, len(reference))
    delay_s = model.total_delay_s if settings.delay_s is None else settings.delay_s
    steps = max(1, math.ceil(settings.period_s / settings.inner_step_s - 1e-9))
    state = _start_state(model, start or (float(reference[0, 0]), 0.0, 0.0), delay_s, settings.period_s / steps)
    out = np.zeros((len(reference), len(closed_loop.OUTPUTS)))
    kernel = compiled(closed_loop.run, control_law=law) if available() else bound(closed_loop.run, control_law=law)
    loop = np.array(gains, dtype=np.float64), np.zeros(LAW_STATES)
    around = settings.resolution_rad, settings.velocity_cutoff_hz, settings.torque_limit_nm
    kernel(np.array(model.pack()), state, *loop, reference, *disturbed, out, settings.period_s, steps, delay_s, *around)
    columns = {name: out[:, i] for i, name in enumerate(closed_loop.OUTPUTS)}
    t_s: Array = np.arange(len(reference), dtype=np.float64) * settings.period_s
    return ClosedLoopRun(t_s=t_s, reference_rad=reference[:, 0], state=state, **columns)


def _samples(values: Array | None, count: int) -> Array:
    """`values` for the kernel; zeros where there are none."""
    return np.zeros(count) if values is None else np.asarray(values, dtype=np.float64)


def _start_state(model: AxisModel, start: tuple[float, float, float], delay_s: float, step_s: float) -> Array:
    """The plant's state at (position, velocity, bristle deflection), motor and load together."""
    state = np.array(rest_state(delay_s, step_s, model.start_temperature_c))
    state[[S_POSITION, S_LOAD_POSITION]] = start[0]
    state[[S_VELOCITY, S_LOAD_VELOCITY]] = start[1]
    state[S_BRISTLE] = start[2]
    return state
