"""Stopping: how fast a joint gets, and how far, when nobody commands it any more and its drive stops it a little later.

Plain floats. The limits act by it in every cycle (servod.runtime.loop.limits), the configuration is checked by it
(servod.formats.stopping). The worst that may be: the last torque, towards the motion, is held for `hold_s`; then the
drive follows its ramp, `lag_s` late, or the joint coasts. The lightest joint gains the most speed, the heaviest brakes
the worst, and only the least friction helps.
"""

from __future__ import annotations

import math
from typing import NamedTuple

#: What a joint may reach while nobody commands it, as a share of its speed limit; reckoned with less, since cogging,
#: noise and the last bit of a sensor are in no model.
OVERSPEED, RECKONED_OVERSPEED = 1.2, 1.15
#: At rest is what stays where it is for so long [s].
REST_S = 0.02
#: A viscous friction whose time constant is longer than so many times `hold_s` makes no difference, and divides badly.
_SLOW = 1e4


class StopFacts(NamedTuple):
    """What a stop is reckoned from, SI at the joint. Loads are torques on the joint with the command's sign, without
    and with all that may hang on it: `load_min_nm` <= 0 <= `load_max_nm`."""

    least_inertia: float
    most_inertia: float
    friction_nm: float  # dry, the least
    viscous: float  # N*m*s/rad, the least
    load_min_nm: float
    load_max_nm: float
    torque_nm: float  # the most, of the limits: what the drive may brake with
    speed_rad_s: float  # of the limits: beyond, the loop stops the joint
    top_rad_s: float  # not exceeded while nobody commands
    position_min_rad: float
    position_max_rad: float
    hold_s: float  # from the loop's last look at the joint to the drive's own reaction
    lag_s: float  # the drive follows its ramp so much later
    deceleration_rad_s2: float  # of the drive's ramp; 0: the drive does not brake, the joint coasts

    @property
    def load_nm(self) -> float:
        """The larger load of both ways."""
        return max(abs(self.load_min_nm), self.load_max_nm)


class Way:
    """One direction of motion; `push_nm` is the load that pushes that way. Speeds and travel count that way."""

    def __init__(self, facts: StopFacts, push_nm: float) -> None:
        self.facts, self.push_nm = facts, push_nm
        hold_s, inertia = facts.hold_s, facts.least_inertia
        time_s = inertia / facts.viscous if facts.viscous * hold_s * _SLOW > inertia else math.inf
        # m*dv/dt = T + push - dry - viscous*v over hold_s, solved for the torque that ends at v_end from v_begin:
        # T = dry - push + rise*v_end - fall*v_begin; the way meanwhile is behind*v_begin + ahead*v_end.
        if math.isinf(time_s):
            self.rise = self.fall = inertia / hold_s
            self.behind = self.ahead = 0.5 * hold_s
        else:
            kept = math.exp(-hold_s / time_s)
            self.rise = facts.viscous / (1.0 - kept)
            self.fall = self.rise * kept
            self.ahead = hold_s / (1.0 - kept) - time_s
            self.behind = (1.0 - kept) * time_s - kept * self.ahead
        self._margin_nm = facts.friction_nm - push_nm
        deceleration = facts.deceleration_rad_s2 or self.coasting_rad_s2
        self.deceleration_rad_s2 = max(deceleration, 1e-9)
        self._late_s = self.ahead + facts.lag_s
        self._top_rad_s = facts.top_rad_s

    @property
    def coasting_rad_s2(self) -> float:
        """How the heaviest joint slows down by its dry friction alone; 0 where the load drives it on."""
        return max(0.0, self._margin_nm) / self.facts.most_inertia

    def end_speed_rad_s(self, room_rad: float, speed_rad_s: float) -> float:
        """The speed at the drive's reaction from which the joint still rests within `room_rad` of here."""
        left_rad = room_rad - self.behind * max(speed_rad_s, 0.0)
        if left_rad <= 0.0:
            return 0.0
        a, late_s = self.deceleration_rad_s2, self._late_s
        return a * (math.sqrt(late_s * late_s + 2.0 * left_rad / a) - late_s)

    def unpowered_rad_s(self, speed_rad_s: float) -> float:
        """The speed at the drive's reaction without torque: friction is not counted on, a load that pushes is."""
        driven = (self.fall * speed_rad_s - self._margin_nm) / self.rise if self._margin_nm < 0.0 else speed_rad_s
        return max(driven, speed_rad_s)

    def most_speed_rad_s(self, top_rad_s: float) -> float:
        """The speed from which a joint without torque has no more than `top_rad_s` at the drive's reaction."""
        return min(
            top_rad_s, (self.rise * top_rad_s + self._margin_nm) / self.fall if self._margin_nm < 0.0 else top_rad_s
        )

    def most_torque_nm(self, speed_rad_s: float, room_rad: float) -> float:
        """The most torque this way after which neither speed nor room is exceeded; never less than none."""
        end_rad_s = min(self._top_rad_s, self.end_speed_rad_s(room_rad, speed_rad_s))
        return max(0.0, self._margin_nm + self.rise * end_rad_s - self.fall * max(speed_rad_s, 0.0))

    def most_held_nm(self, held_nm: float, speed_rad_s: float, room_rad: float) -> float:
        """The most torque this way of which `held_nm` is proven to be held, friction and all."""
        end_rad_s = min(self._top_rad_s, self.end_speed_rad_s(room_rad, speed_rad_s))
        return held_nm + self.facts.least_inertia / self.facts.hold_s * (end_rad_s - speed_rad_s)

    def too_near(self, speed_rad_s: float, room_rad: float) -> bool:
        """Without any torque, too, the joint would leave its room: time for the drive to stop it."""
        return speed_rad_s > 0.0 and not self.unpowered_rad_s(speed_rad_s) <= self.end_speed_rad_s(
            room_rad, speed_rad_s
        )

    def travel_rad(self, speed_rad_s: float, end_rad_s: float) -> float:
        """Way from `speed_rad_s` to rest, over `end_rad_s` at the drive's reaction."""
        braking_rad = end_rad_s * end_rad_s / (2.0 * self.deceleration_rad_s2)
        return self.behind * speed_rad_s + self._late_s * end_rad_s + braking_rad

    def coasting_rad(self, speed_rad_s: float) -> float:
        """Way from `speed_rad_s` to rest by friction alone; infinite where the load drives the joint on."""
        if self._margin_nm <= 0.0:
            return math.inf
        return self.facts.most_inertia * speed_rad_s * speed_rad_s / (2.0 * self._margin_nm)


def both_ways(facts: StopFacts) -> tuple[Way, Way]:
    """Towards greater positions, and towards lesser ones."""
    return Way(facts, facts.load_max_nm), Way(facts, -facts.load_min_nm)
