"""What the experiments may use of the axis: travel, speed, torque and distance from the reference.

Taken from the configured limits with a margin, so that an experiment never meets the limits' own reactions.
"""

from __future__ import annotations

from dataclasses import dataclass

from servod.common.errors import AnswerIsNo
from servod.formats.config import AxisConfig, LimitsConfig
from servod.kernels.filters import velocity_delay_s

#: Share of each configured limit that experiments use.
SHARE = 0.85

#: Speed is planned further away from its limit: the multisine comes on top of it.
SPEED_SHARE = 0.5

#: Half of the longest travel that is of use, in rad: cogging from three periods a turn on shows all of itself.
LONGEST_TRAVEL_RAD = 1.1

#: Below this half travel there is no steady sliding to be had.
SHORTEST_TRAVEL_RAD = 0.02


@dataclass(frozen=True)
class Bounds:
    """Positions are relative to where the axis stands when the experiments begin."""

    travel_rad: float  # half range, centred by `centre_rad`
    centre_rad: float
    speed_rad_s: float  # experiments plan for no more
    most_rad_s: float  # no motion may show more
    torque_nm: float
    window_rad: float


def bounds_from(
    limits: LimitsConfig, position_rad: float, travel_rad: float | None, speed_rad_s: float | None
) -> Bounds:
    """Bounds from the limits and the present position; `travel_rad`, `speed_rad_s` are a user's narrower ones.

    Raises AnswerIsNo where the range that is left is too short.
    """
    low, high = limits.position_min_rad - position_rad, limits.position_max_rad - position_rad
    wanted = min(LONGEST_TRAVEL_RAD, travel_rad or LONGEST_TRAVEL_RAD)
    half = min(wanted, 0.5 * SHARE * (high - low))
    centre = min(max(0.0, SHARE * low + half), high * SHARE - half) if low < 0.0 < high else 0.0
    if low >= 0.0 or high <= 0.0 or half < SHORTEST_TRAVEL_RAD:
        raise AnswerIsNo(f"only {1e3 * half:.0f} mrad of travel are left; move the joint to the middle of its range")
    most = min(SHARE * limits.speed_rad_s, speed_rad_s or limits.speed_rad_s)
    speed = min(SPEED_SHARE * limits.speed_rad_s, SHARE * most)
    return Bounds(half, centre, speed, most, SHARE * limits.torque_nm, SHARE * limits.following_error_rad)


# --- Feedback for the experiments ------------------------------------------------------------------------------------
# PD feedback for the experiments, from what is known of the joint so far. The crossover is a share of what the loop's
# whole lag (delay, hold, velocity filter) allows, so that the same rule holds for every size of axis.


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
