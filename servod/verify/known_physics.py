"""Which effects of an axis model the sampled loop has in it, and which it leaves out.

Stands on the axis model, under the checks. Drawn plants are simulated with every effect, but poles and margins are of
a rigid joint with bristle, delay, gain and slopes over position: a certificate must not pass over the rest in silence.
"""

from __future__ import annotations

from collections.abc import Iterator

from servod.axis_model import AxisModel
from servod.verify.sampled import LONGEST_LAG

#: Effects that change the loop around small deviations in a way that no pole, LMI or margin has in it.
UNKNOWN = (
    *("joint_elasticity", "backlash", "torque_saturation", "torque_ripple", "position_dependent_inertia"),
    *("load_dependent_friction", "position_dependent_friction", "thermal", "encoder_eccentricity", "residual"),
)


def unknown_physics(model: AxisModel, period_s: float) -> Iterator[str]:
    """Keys of the model that the loop check leaves out; a disturbance and noise act from outside and close no loop."""
    for name in UNKNOWN:
        if getattr(model, name) is not None:
            yield name
    lag = model.actuator_lag
    if lag is not None and lag.time_constant_s > LONGEST_LAG * period_s:
        yield "actuator_lag.time_constant_s"
    if lag is not None and lag.slew_per_s is not None:
        yield "actuator_lag.slew_per_s"
