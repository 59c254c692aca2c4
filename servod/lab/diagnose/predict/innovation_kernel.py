"""One-step predictions of a recorded motion, as a kernel: the model under the recorded command, pulled to the encoder.

Compiled by `servod.lab.diagnose.predict.predict`. Between two rows the model runs freely; at each row its motion is
corrected by fixed gains. What is left at a row before the correction is the innovation: noise when the model is right
(Ljung, System Identification, 1999, ch. 7: prediction-error methods).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from servod.kernels.physics.effects import encoder_position, heat, thermal_factors
from servod.kernels.physics.layout import PlantParameters, PlantState, Tables
from servod.lab.diagnose.predict.sample_step import step
from servod.lab.simulate.open_loop import acting, begin, piece_end, switch_row


def innovate(
    p: PlantParameters,
    tables: Tables,
    s: PlantState,
    t: Any,
    torque: Sequence[float],
    before: float,
    temperature: Any,
    position: Any,
    steps: Any,
    position_gain: Any,
    velocity_gain: Any,
    load_share: float,
    quiet: float,
    starts: Any,
    start_states: Any,
    out: Any,
) -> None:
    """Fill `out` with recorded minus predicted position of each row.

    `steps` are inner steps from each row to the next; `position_gain` and `velocity_gain` (1/s) the shares of the
    innovation that correct the motion at each row, `load_share` of them for the load. A correction of the position is
    motion to the bristle, else a model that sticks could be held along by its own break-away torque while the joint
    slides; but not where the innovation is within `quiet`, for noise would wear the bristle off. Rows in `starts` begin
    anew from the rows of `start_states` (position, velocity, bristle, load position, load velocity, actuator torque).
    """
    window, row, last, acceleration = 0, -1, len(t) - 1, 0.0
    for k in range(len(t)):
        s.time_s = t[k]
        if window < len(starts) and starts[window] == k:
            begin(s, start_states[window])
            window += 1
        off = position[k] - encoder_position(p, tables, s.position)
        out[k] = off
        if k == last:
            break
        correct(s, position_gain[k] * off, velocity_gain[k] * off, load_share)
        now, whole = t[k], t[k + 1] - t[k]
        dry, viscous = thermal_factors(p, s, temperature[k])
        loss = 0.0
        beyond = max(abs(off) - quiet, 0.0)
        pull = math.copysign(position_gain[k] * beyond / whole, off) if whole > 0.0 else 0.0
        if steps[k] == 1:
            row, command = mean_command(t, torque, before, row, p.delay_s, now, t[k + 1])
            acceleration = step(p, tables, s, command, whole, acceleration, dry, viscous, pull)
            loss, now = s.friction * s.velocity * whole, t[k + 1]
        while now < t[k + 1]:
            row = switch_row(t, row, now, p.delay_s)
            end = piece_end(t, row, p.delay_s, t[k + 1])
            count = max(1, round(steps[k] * (end - now) / whole))
            command, h = acting(torque, row, before), (end - now) / count
            for _ in range(count):
                acceleration = step(p, tables, s, command, h, acceleration, dry, viscous, pull)
                loss += s.friction * s.velocity * h
            now = end
        heat(p, s, loss, whole, temperature[k])


def mean_command(
    t: Any, torque: Sequence[float], before: float, row: int, delay_s: float, now: float, end: float
) -> tuple[int, float]:
    """The row whose command acts last before `end`, and the mean of the commands that act from `now` to `end`.

    One step under the mean costs an order less than the observer shows: (rate*step)^2/8 of a command's change.
    """
    begun, push = now, 0.0
    while now < end:
        row = switch_row(t, row, now, delay_s)
        until = piece_end(t, row, delay_s, end)
        push += acting(torque, row, before) * (until - now)
        now = until
    return row, push / (end - begun)


def correct(s: PlantState, shift: float, push: float, load_share: float) -> None:
    """Correct the motion of the motor, and by `load_share` of it that of the load."""
    s.position += shift
    s.load_position += load_share * shift
    s.velocity += push
    s.load_velocity += load_share * push
