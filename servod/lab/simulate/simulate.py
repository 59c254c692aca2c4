"""Closed-loop simulator: an axis model under any control law, hundreds to thousands of times faster than real time.

Used by synthesis, verification, demo reports and tests; off the control path. The law is the function that the loop
calls, the physics is the one of the virtual plant; both compiled here (numpy and numba: the `lab` extra).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import Law
from servod.kernels.laws.state import LawState
from servod.kernels.physics.compiled import arrays, available, bound, compiled, record
from servod.kernels.physics.dynamics import advance
from servod.kernels.physics.effects import encoder_position
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables
from servod.kernels.physics.plant import INNER_STEP_S, delay_line, inputs

# --- The closed loop -------------------------------------------------------------------------------------------------
# The closed loop as a kernel: axis, encoder, velocity filter, delay and any control law, sample by sample. Compiled by
# `servod.lab.simulate.simulate`, which puts the law in place of `control_law`. The velocity filter is that of the
# encoder driver (difference over the measured time, exact first-order low-pass), so simulator and axis agree.


#: A row of the kernel's output, in this order.
OUTPUTS: tuple[str, ...] = (
    "position_rad",
    "encoder_rad",
    "velocity_rad_s",
    "true_velocity_rad_s",
    "torque_nm",
    "feedback_nm",
    "friction_nm",
    "other_nm",
)


def control_law(
    gains: Any,
    law_state: Any,
    x_ref: float,
    v_ref: float,
    a_ref: float,
    x: float,
    v: float,
    u_applied: float,
    dt: float,
) -> tuple[float, float, float, float]:
    """No control: the axis coasts. `simulate` puts the law that shall run in this function's place."""
    return 0.0, 0.0, 0.0, 0.0


def run(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    line: Any,
    gains: Any,
    law_state: Any,
    reference: Any,
    external: Any,
    reading: Any,
    out: Any,
    dt: float,
    steps: int,
    delay_s: float,
    resolution_rad: float,
    cutoff_hz: float,
    limit_nm: float,
    rate_nm_per_s: float,
) -> None:
    """Run the loop over the rows of `reference` (position, velocity, acceleration); fills the rows of `out`.

    The command of sample k acts from t_k + delay_s. `resolution_rad` 0 means an encoder without steps; `external` is
    a torque for each sample beside the command, `reading` an error of each encoder reading in rad. The law sees the
    torque that was applied after `rate_nm_per_s` and `limit_nm`, which come in the order of the axis's own limits.
    """
    kept = math.exp(-2.0 * math.pi * cutoff_hz * dt)
    applied, filtered, change_nm = 0.0, s.velocity, rate_nm_per_s * dt
    seen = quantised(encoder_position(p, tables, s.position) + reading[0], resolution_rad)
    for k in range(len(reference)):
        last, seen = seen, quantised(encoder_position(p, tables, s.position) + reading[k], resolution_rad)
        if k > 0:
            filtered = kept * filtered + (1.0 - kept) * (seen - last) / dt
        x_ref, v_ref, a_ref = reference[k][0], reference[k][1], reference[k][2]
        asked = control_law(gains, law_state, x_ref, v_ref, a_ref, seen, filtered, applied, dt)
        slewed = min(max(asked[0], applied - change_nm), applied + change_nm)
        applied = min(max(slewed, -limit_nm), limit_nm)
        row = out[k]
        row[0], row[1], row[2], row[3] = s.load_position, seen, filtered, s.velocity
        row[4], row[5], row[6], row[7] = applied, asked[1], asked[2], asked[3]
        advance(p, tables, s, line, applied, external[k], steps, dt / steps, delay_s, math.nan)


def quantised(position_rad: float, resolution_rad: float) -> float:
    """The encoder's nearest count, as an angle."""
    if resolution_rad <= 0.0:
        return position_rad
    return math.floor(position_rad / resolution_rad + 0.5) * resolution_rad


Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """What stands around the law: sample time, encoder, velocity filter and the last limits."""

    period_s: float = 0.001
    counts_per_turn: float = 2.0**20  # 0 = no steps
    velocity_cutoff_hz: float = 120.0
    torque_limit_nm: float = math.inf
    delay_s: float | None = None  # None = the model's
    inner_step_s: float = INNER_STEP_S
    torque_rate_nm_per_s: float = math.inf

    @property
    def resolution_rad(self) -> float:
        """Angle of one count; 0 for an encoder without steps."""
        return 2.0 * math.pi / self.counts_per_turn if self.counts_per_turn else 0.0


@dataclass(frozen=True, slots=True)
class ClosedLoopRun:
    """One simulated motion, a value for each sample; torques in N*m, positions in rad.

    `position_rad` is the true joint (load) position, `encoder_rad` what the law saw, `velocity_rad_s` the filtered
    velocity that it saw.
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

    def tracking_error_rad(self, after_s: float = 0.0) -> Array:
        """Reference minus true position, from `after_s` on."""
        return (self.reference_rad - self.position_rad)[self.t_s >= after_s]


def simulate_closed_loop(
    model: AxisModel,
    law: Law,
    gains: Sequence[float],
    reference: Array,
    settings: LoopSettings | None = None,
    *,
    external_nm: Array | None = None,
    reading_rad: Array | None = None,
    start: tuple[float, float, float] | None = None,
) -> ClosedLoopRun:
    """Run `model` under `law` along `reference` (rows of position, velocity, acceleration, one for each sample).

    `gains` are the flat parameters of `law`, as a gain set packs them. `external_nm` acts beside the
    command, `reading_rad` is the error of each encoder reading; `start` is (position, velocity, bristle deflection), by
    default at rest on the reference's first position.
    """
    settings = settings or LoopSettings()
    reference = np.ascontiguousarray(reference, dtype=np.float64)
    disturbed = _samples(external_nm, len(reference)), _samples(reading_rad, len(reference))
    delay_s = model.total_delay_s if settings.delay_s is None else settings.delay_s
    steps = max(1, math.ceil(settings.period_s / settings.inner_step_s - 1e-9))
    axis = inputs(model.pack(), _start_state(model, start or (float(reference[0, 0]), 0.0, 0.0)), bare=True)
    line = np.array(delay_line(delay_s, settings.period_s / steps))
    out = np.zeros((len(reference), len(OUTPUTS)))
    named, law_state = law.named(tuple(float(value) for value in gains)), LawState()
    if available():
        kernel, loop = compiled(run, control_law=law.step), (arrays(named), record(law_state).memory[0])
    else:
        kernel, loop = bound(run, control_law=law.step), (named, law_state)
    limits = settings.torque_limit_nm, settings.torque_rate_nm_per_s
    around = settings.resolution_rad, settings.velocity_cutoff_hz, *limits
    kernel(*axis, line, *loop, reference, *disturbed, out, settings.period_s, steps, delay_s, *around)
    columns = {name: out[:, i] for i, name in enumerate(OUTPUTS)}
    t_s: Array = np.arange(len(reference), dtype=np.float64) * settings.period_s
    return ClosedLoopRun(t_s=t_s, reference_rad=reference[:, 0], **columns)


def _samples(values: Array | None, count: int) -> Array:
    """`values` for the kernel; zeros where there are none."""
    return np.zeros(count) if values is None else np.asarray(values, dtype=np.float64)


def _start_state(model: AxisModel, start: tuple[float, float, float]) -> PlantState:
    """The plant's state at (position, velocity, bristle deflection), motor and load together."""
    position, velocity, bristle = start
    return PlantState(
        position=position,
        velocity=velocity,
        bristle=bristle,
        load_position=position,
        load_velocity=velocity,
        temperature_c=model.start_temperature_c,
    )
