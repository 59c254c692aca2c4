"""PD feedback for the experiments, from what is known of the joint so far.

Under the walk. The crossover is a share of what the loop's whole lag (delay, hold, velocity filter) allows, so that the
same rule holds for every size of axis.
"""

from __future__ import annotations

from servod.drivers.cia406 import velocity_delay_s
from servod.formats.config import AxisConfig

#: Crossover times lag: careful while only the kicks are known, stiff once the delay is.
CAREFUL, STIFF = 0.42, 0.62
#: Position gain over velocity gain, against the crossover.
POSITION_SHARE = 0.25


def loop_lag_s(config: AxisConfig, delay_s: float) -> float:
    """From velocity to the torque that answers it: encoder filter, half a hold, command to torque."""
    period_s = config.cycle.period_us * 1e-6
    return velocity_delay_s(period_s, config.encoder.velocity_cutoff_hz) + 0.5 * period_s + delay_s


def feedback(config: AxisConfig, inertia: float, delay_s: float, share: float) -> tuple[float, float]:
    """(position gain, velocity gain) in N*m/rad and N*m*s/rad."""
    crossover = share / loop_lag_s(config, delay_s)
    return POSITION_SHARE * inertia * crossover**2, inertia * crossover
