"""How steeply torques over position rise and fall: cogging, gravity and springs act on the feedback as stiffness.

Stands on the axis model, under the loop check. What is fed forward goes by the reference and closes no loop, so the
whole slope stays in the loop, fed forward or not.
"""

from __future__ import annotations

from servod.formats.model.axis_model import AxisModel, wave_number

SPRING_STRETCH_RAD = 1.0  # at which a stiffening spring is judged


def position_slopes(model: AxisModel, gain: float) -> tuple[float, float]:
    """(most falling, most rising) slope of the resisting torque over position, per unit of torque gain [N*m/rad].

    Bounds: the slopes of all waves are summed as if they met in one place. Both 0.0 without such torques.
    """
    waves = model.cogging.harmonics if model.cogging else ()
    slope = sum(abs(wave.amplitude) * wave_number(wave) for wave in waves)
    slope += abs(model.gravity.amplitude) if model.gravity else 0.0
    spring = model.spring
    stiffness = spring.stiffness + 3.0 * spring.cubic * SPRING_STRETCH_RAD**2 if spring else 0.0
    return -slope / gain, (slope + stiffness) / gain
