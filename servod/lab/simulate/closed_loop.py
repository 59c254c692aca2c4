"""The closed loop as a kernel: axis, encoder, velocity filter, delay and any control law, sample by sample.

Compiled by `servod.lab.simulate.simulate`, which puts the law in place of `control_law`. The velocity filter is that
of the
encoder driver (difference over the measured time, exact first-order low-pass), so simulator and axis agree.
"""

from __future__ import annotations

import math
from typing import Any

from servod.kernels.physics.dynamics import advance
from servod.kernels.physics.effects import encoder_position
from servod.kernels.physics.friction import Params
from servod.kernels.physics.layout import S_LOAD_POSITION, S_POSITION, S_VELOCITY

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
    p: Params,
    s: Any,
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
) -> None:
    """Run the loop over the rows of `reference` (position, velocity, acceleration); fills the rows of `out`.

    The command of sample k acts from t_k + delay_s. `resolution_rad` 0 means an encoder without steps; `external` is
    a torque for each sample beside the command, `reading` an error of each encoder reading in rad. The law sees the
    torque that was applied after `limit_nm`.
    """
    kept = math.exp(-2.0 * math.pi * cutoff_hz * dt)
    applied, filtered = 0.0, s[S_VELOCITY]
    seen = quantised(encoder_position(p, s[S_POSITION]) + reading[0], resolution_rad)
    for k in range(len(reference)):
        last, seen = seen, quantised(encoder_position(p, s[S_POSITION]) + reading[k], resolution_rad)
        if k > 0:
            filtered = kept * filtered + (1.0 - kept) * (seen - last) / dt
        x_ref, v_ref, a_ref = reference[k][0], reference[k][1], reference[k][2]
        asked = control_law(gains, law_state, x_ref, v_ref, a_ref, seen, filtered, applied, dt)
        applied = min(max(asked[0], -limit_nm), limit_nm)
        row = out[k]
        row[0], row[1], row[2], row[3] = s[S_LOAD_POSITION], seen, filtered, s[S_VELOCITY]
        row[4], row[5], row[6], row[7] = applied, asked[1], asked[2], asked[3]
        advance(p, s, applied, external[k], steps, dt / steps, delay_s, math.nan)


def quantised(position_rad: float, resolution_rad: float) -> float:
    """The encoder's nearest count, as an angle."""
    if resolution_rad <= 0.0:
        return position_rad
    return math.floor(position_rad / resolution_rad + 0.5) * resolution_rad
