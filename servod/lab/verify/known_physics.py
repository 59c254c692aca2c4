"""What of an axis model no check of the sampled loop can carry.

Stands on the axis model, under the checks of effects. Drawn plants are simulated with every effect, but poles and
margins are of a joint that is linearised: a certificate must not pass over the rest in silence.
"""

from __future__ import annotations

from collections.abc import Iterator

from servod.formats.model.axis_model import AxisModel
from servod.lab.verify.effect_reach import Level
from servod.lab.verify.sampled import LONGEST_LAG

#: Periods in which the torque must get from one end to the other: slower, its rate limit is a lag that grows.
SLEW_PERIODS = 5.0


def unknown_physics(model: AxisModel, period_s: float, level: Level) -> Iterator[str]:
    """Keys of the model that stay out of the loop, and why; what acts from outside closes no loop and is none."""
    lag, limit, load = model.actuator_lag, model.torque_saturation, model.load_dependent_friction
    if lag is not None and lag.time_constant_s > LONGEST_LAG * period_s:
        yield "actuator_lag.time_constant_s is longer than a cycle"
    slew = lag.slew_per_s if lag is not None else None
    if slew is not None and slew * SLEW_PERIODS * period_s < 2.0 * level.torque_nm:
        yield f"actuator_lag.slew_per_s turns the torque around in more than {SLEW_PERIODS:g} cycles"
    if limit is not None and min(limit.limit, limit.negative_limit or limit.limit) < level.torque_nm:
        yield f"torque_saturation.limit is below the {level.torque_nm:.3g} N*m of friction and load"
    if load is not None and load.per_command >= 0.9:
        yield "load_dependent_friction.per_command lets friction take what is commanded"
