"""The law's feed-forward of what the axis model knows over position: gravity, cogging, spring, constant torque.

Stands on the axis model; its result is the `position_feedforward` block of a gain set. Torques are divided by the
model's torque gain, as the steady friction is: what the law must ask for, not what the joint feels.
"""

from __future__ import annotations

from servod.formats.gains.parameters import PositionFeedforward, PositionWave
from servod.formats.model.axis_model import AxisModel, wave_number
from servod.formats.model.effects import Spring
from servod.kernels.laws.position import MAX_WAVES


def position_feedforward(model: AxisModel, gain: float, period_s: float) -> PositionFeedforward | None:
    """What holds against the position-dependent torques of `model` with torque gain `gain`; None where it has none.

    Of more waves than the law holds, the largest are taken. The reference is led by the delay, the actuator's lag and
    half a period, the middle of the time for which a command acts.
    """
    waves = sorted(_waves(model, gain), key=lambda w: -abs(w.amplitude_nm))[:MAX_WAVES]
    if not waves and model.spring is None and model.torque_offset == 0.0:
        return None
    spring = model.spring or Spring()
    lag_s = model.actuator_lag.time_constant_s if model.actuator_lag else 0.0
    return PositionFeedforward(
        lead_s=model.total_delay_s + lag_s + 0.5 * period_s,
        offset_nm=-model.torque_offset / gain,
        spring_nm_per_rad=spring.stiffness / gain,
        spring_rest_rad=spring.rest,
        spring_cubic_nm_per_rad3=spring.cubic / gain,
        waves=waves,
    )


def _waves(model: AxisModel, gain: float) -> list[PositionWave]:
    """Gravity as one wave a turn, then the harmonics of cogging."""
    gravity = model.gravity
    first = [(gravity.amplitude, 1.0, gravity.phase)] if gravity else []
    harmonics = model.cogging.harmonics if model.cogging else ()
    rows = [*first, *((h.amplitude, wave_number(h), h.phase) for h in harmonics)]
    return [PositionWave(amplitude_nm=a / gain, waves_per_turn=n, phase_rad=phase) for a, n, phase in rows if a != 0.0]
