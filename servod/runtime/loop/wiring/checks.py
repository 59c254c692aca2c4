"""What the bounded test of the wiring may do and what its answers must look like: bounds and checks, on plain floats.

Below the test's state machine (servod.runtime.loop.wiring.wiring_test). Every check gives a verdict or None; none of
them
knows the cycle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from servod.common.units import NS_PER_S, NS_PER_US, PER_MILLE, TWO_PI
from servod.formats.config import AxisConfig
from servod.runtime.loop.wiring.findings import WiringOutcome

#: Share of the torque and speed limits that the test uses, so that it never meets the limits' own reactions.
SHARE = 0.9
#: The ramp begins at this share of the most torque: below what moves any joint that the drive suits.
FIRST_SHARE = 0.001
#: What counts as a motion: this far, and this many counts of the coarser sensor.
TRAVEL_RAD, TRAVEL_COUNTS = 1e-3, 6.0
#: Where the joint may get to from its start, with all that it slides on: this far, or this many counts.
MOST_TRAVEL_RAD, MOST_TRAVEL_COUNTS = 0.05, 100.0
#: One sensor alone may move by this many travels, or this share of limits.encoder_mismatch_rad: slack in the gear.
LONE_TRAVELS, LONE_SHARE = 4.0, 0.5
#: limits.torque_nm over the drive's rated torque: a joint on 1 % of its drive, and on 20 times its rating.
RATED_LOWEST, RATED_HIGHEST = 0.01, 20.0
#: Ways of both sensors over each other, and counts of the coarser one on top.
SCALE_RATIO, SCALE_COUNTS = 1.4, 3.0
#: 0x6077 over the demand, and how many of its steps the demand must reach for that to tell anything.
ACTUAL_LOWEST, ACTUAL_HIGHEST, ACTUAL_COUNTS = 0.5, 2.0, 5.0
#: 0x6077 while no torque is demanded: this share of limits.torque_nm, and ACTUAL_COUNTS of its steps.
AT_REST_SHARE = 0.05
#: Break-away over what was expected: temperature, wear and the ramp's lag change it by less.
FRICTION_RATIO_LOW, FRICTION_RATIO_HIGH = 0.2, 10.0
#: Where nothing is expected: less than this share of limits.torque_nm moves no joint.
LEAST_SHARE = 0.005
#: An expected friction near nothing is no bound: this share of limits.torque_nm is always allowed.
ALLOWED_SHARE = 0.05
#: Most torque over the most friction that passes, where friction is expected: a load comes on top, or too much shows.
MOST_RATIO = 1.5
#: Energy of the motion over the work of the torque; gravity may help as much as four times the torque.
MOST_ENERGY = 30.0
#: A motion under the very first torque, or up to this multiple of it.
FIRST_RATIO = 1.5


class CheckResult(NamedTuple):
    """A finding, what was found, and the range that would have been right."""

    finding: WiringOutcome
    found: float = math.nan
    lowest: float = math.nan
    highest: float = math.nan


class WiringTestBounds(NamedTuple):
    """What the test may do, and what the devices and the joint are said to be; SI units at the joint."""

    period_s: float
    most_nm: float
    first_nm: float
    growth_per_s: float
    rate_nm_per_s: float
    travel_rad: float
    most_travel_rad: float
    lone_travel_rad: float
    most_rad_s: float
    timeout_s: float
    middle_rad: float
    limit_nm: float
    encoder_count_rad: float
    amplifier_count_rad: float
    torque_count_nm: float  # NaN where the driver does not tell
    inertia: float  # NaN where nobody says
    friction_nm: float  # NaN where nobody says


def wiring_test_bounds(config: AxisConfig, amplifier_facts: Mapping[str, Any]) -> WiringTestBounds:
    """The bounds of one axis; `amplifier_facts` are those of its node plan (rated torque as the drive says)."""
    asked, limits = config.wiring_proof, config.limits
    amplifier, encoder = config.amplifier, config.encoder
    encoder_count = TWO_PI / encoder.counts_per_turn
    amplifier_count = TWO_PI / (amplifier.counts_per_turn * amplifier.gear_ratio)
    torque_count = float(amplifier_facts.get("rated_torque_nm", math.nan)) * amplifier.gear_ratio / PER_MILLE
    most_travel = asked.most_travel_rad or max(MOST_TRAVEL_RAD, MOST_TRAVEL_COUNTS * encoder_count)
    travel = max(asked.travel_rad or TRAVEL_RAD, TRAVEL_COUNTS * max(encoder_count, amplifier_count))
    travel = min(travel, most_travel / 3.0)
    lone_travel = max(LONE_TRAVELS * travel, LONE_SHARE * limits.encoder_mismatch_rad)
    bounds = WiringTestBounds(
        period_s=config.cycle.period_us * NS_PER_US / NS_PER_S,
        most_nm=asked.torque_nm or SHARE * limits.torque_nm,
        first_nm=0.0,
        growth_per_s=-math.log(FIRST_SHARE) / asked.ramp_s,
        rate_nm_per_s=SHARE * limits.torque_rate_nm_per_s,
        travel_rad=travel,
        most_travel_rad=most_travel,
        lone_travel_rad=min(lone_travel, 0.8 * most_travel),
        most_rad_s=asked.speed_rad_s or SHARE * limits.speed_rad_s,
        timeout_s=asked.timeout_s,
        middle_rad=0.5 * (limits.position_min_rad + limits.position_max_rad),
        limit_nm=limits.torque_nm,
        encoder_count_rad=encoder_count,
        amplifier_count_rad=amplifier_count,
        torque_count_nm=torque_count,
        inertia=math.nan if asked.inertia is None else asked.inertia,
        friction_nm=math.nan if asked.friction_nm is None else asked.friction_nm,
    )
    return _with_torques(bounds, asked.torque_nm is None)


def _with_torques(bounds: WiringTestBounds, capped: bool) -> WiringTestBounds:
    """First and most torque; `capped`: no more than what is expected of the joint needs, where that is known."""
    most_nm = min(bounds.most_nm, MOST_RATIO * friction_range(bounds)[1]) if capped else bounds.most_nm
    first_nm = FIRST_SHARE * most_nm
    if math.isfinite(bounds.torque_count_nm):
        first_nm = max(first_nm, bounds.torque_count_nm)
    return bounds._replace(most_nm=most_nm, first_nm=min(first_nm, most_nm))


class Push:
    """One ramp of torque in one direction and what moved under it. Positions are the sensors' own."""

    def __init__(self, sign: float, encoder_rad: float, amplifier_rad: float) -> None:
        self.sign = sign
        self.encoder_rad, self.amplifier_rad = encoder_rad, amplifier_rad  # where it started
        self.began_nm = self.began_s = math.nan  # torque, magnitude, and time at the first sign of a motion
        self.began_encoder_rad = self.began_amplifier_rad = 0.0
        self.furthest_encoder_rad, self.furthest_amplifier_rad = encoder_rad, amplifier_rad
        self.cut_nm = self.cut_s = math.nan
        self.commanded_nm = 0.0  # the most that went out, which limits may have narrowed

    def see(self, encoder_rad: float, amplifier_rad: float) -> None:
        """One cycle, until the joint stands again: where each sensor was furthest along the torque."""
        self.furthest_encoder_rad = self.sign * max(self.sign * self.furthest_encoder_rad, self.sign * encoder_rad)
        self.furthest_amplifier_rad = self.sign * max(
            self.sign * self.furthest_amplifier_rad, self.sign * amplifier_rad
        )

    def begin_way(self, encoder_rad: float, amplifier_rad: float) -> None:
        """The way counts from here."""
        self.encoder_rad = self.furthest_encoder_rad = encoder_rad
        self.amplifier_rad = self.furthest_amplifier_rad = amplifier_rad

    def begin_motion(self, torque_nm: float, time_s: float, encoder_rad: float, amplifier_rad: float) -> None:
        """The joint has begun to move."""
        self.began_nm, self.began_s = torque_nm, time_s
        self.began_encoder_rad, self.began_amplifier_rad = encoder_rad, amplifier_rad

    @property
    def began(self) -> bool:
        """The joint has begun to move, or to yield: a blocked one does so too."""
        return not math.isnan(self.began_nm)

    @property
    def moved(self) -> bool:
        """The joint has moved by the travel that was asked for, which ended the torque."""
        return not math.isnan(self.cut_nm)

    def ways(self, encoder_rad: float, amplifier_rad: float) -> tuple[float, float]:
        """Both sensors' ways since the start, positive along the torque."""
        return self.sign * (encoder_rad - self.encoder_rad), self.sign * (amplifier_rad - self.amplifier_rad)

    def late_ways(self, encoder_rad: float, amplifier_rad: float) -> tuple[float, float]:
        """Both ways since the joint began to move: slack is taken up by then."""
        return (
            self.sign * (encoder_rad - self.began_encoder_rad),
            self.sign * (amplifier_rad - self.began_amplifier_rad),
        )


class TorqueLine:
    """Slope of a straight line through demanded and shown torque; a constant offset of 0x6077 is left out of it."""

    def __init__(self) -> None:
        self._count = self._demand = self._actual = self._square = self._product = self.most_nm = 0.0

    def add(self, demand_nm: float, actual_nm: float) -> None:
        """One cycle."""
        self._count += 1.0
        self._demand += demand_nm
        self._actual += actual_nm
        self._square += demand_nm * demand_nm
        self._product += demand_nm * actual_nm
        self.most_nm = max(self.most_nm, abs(demand_nm))

    @property
    def slope(self) -> float:
        """Shown over demanded; NaN while the demand has not changed."""
        spread = self._count * self._square - self._demand * self._demand
        return (self._count * self._product - self._demand * self._actual) / spread if spread > 0.0 else math.nan


def rated_torque(bounds: WiringTestBounds) -> CheckResult | None:
    """Before any torque: limit and drive must be of one size, and the drive must be able to tell small torques."""
    ratio = bounds.limit_nm / (PER_MILLE * bounds.torque_count_nm)
    if math.isnan(ratio) or RATED_LOWEST <= ratio <= RATED_HIGHEST:
        return None
    return CheckResult(WiringOutcome.RATED_TORQUE, ratio, RATED_LOWEST, RATED_HIGHEST)


def signs(ways: tuple[float, float]) -> CheckResult | None:
    """Both ways along the torque."""
    encoder, amplifier = ways
    if encoder < 0.0 and amplifier < 0.0:
        return CheckResult(WiringOutcome.TORQUE_POLARITY, -1.0, 1.0, 1.0)
    if encoder < 0.0:
        return CheckResult(WiringOutcome.ENCODER_DIRECTION, -1.0, 1.0, 1.0)
    return CheckResult(WiringOutcome.AMPLIFIER_DIRECTION, -1.0, 1.0, 1.0) if amplifier < 0.0 else None


def sensors(
    whole: tuple[float, float], late: tuple[float, float], bounds: WiringTestBounds, noise_rad: float, skew_rad: float
) -> CheckResult | None:
    """Stillness, signs and scale of both sensors. A wrong scale shows in the whole way and in its late part alike;
    slack only in the first, a spring that unwinds only in the second. `skew_rad`: what two sensors that are right may
    differ by while the joint moves, for neither shows the very moment."""
    encoder, amplifier = abs(whole[0]), abs(whole[1])
    step_rad = max(bounds.encoder_count_rad, bounds.amplifier_count_rad)
    blur_rad = step_rad + noise_rad
    if encoder <= blur_rad < amplifier:
        return CheckResult(WiringOutcome.ENCODER_STILL, amplifier)
    if amplifier <= blur_rad < encoder:
        return CheckResult(WiringOutcome.AMPLIFIER_STILL, encoder)
    if verdict := signs(whole):
        return verdict
    allowed_rad = SCALE_COUNTS * step_rad + noise_rad + skew_rad
    longer = {_longer(ways, allowed_rad) for ways in (whole, late)}
    if longer in ({1}, {-1}):
        return CheckResult(WiringOutcome.POSITION_SCALE, amplifier / encoder, 1.0 / SCALE_RATIO, SCALE_RATIO)
    return None


def _longer(ways: tuple[float, float], allowed_rad: float) -> int:
    """Which of two ways is the longer by more than SCALE_RATIO and `allowed_rad`: 1 encoder, -1 amplifier, 0 none."""
    encoder, amplifier = abs(ways[0]), abs(ways[1])
    if max(encoder, amplifier) <= SCALE_RATIO * min(encoder, amplifier) + allowed_rad:
        return 0
    return 1 if encoder > amplifier else -1


def first_torque(push: Push, bounds: WiringTestBounds) -> CheckResult | None:
    """A joint that moves under the very first torque, which was to move none: far more torque acts than was asked."""
    lowest_nm = FIRST_RATIO * bounds.first_nm
    if push.began_nm > lowest_nm or bounds.friction_nm <= 2.0 * lowest_nm:
        return None
    return CheckResult(WiringOutcome.TOO_EASY, push.began_nm, max(lowest_nm, friction_range(bounds)[0]))


def energy(push: Push, encoder_rad: float, bounds: WiringTestBounds) -> CheckResult | None:
    """Energy of the motion against the work that the torque can have done on the way, where the inertia is known."""
    passed_s = push.cut_s - push.began_s
    if math.isnan(bounds.inertia) or not passed_s > 0.0:
        return None
    speed_rad_s = push.late_ways(encoder_rad, 0.0)[0] / passed_s
    work = push.cut_nm * abs(encoder_rad - push.encoder_rad)
    ratio = 0.5 * bounds.inertia * speed_rad_s * speed_rad_s / work if work > 0.0 else math.inf
    return CheckResult(WiringOutcome.TOO_FAST, ratio, 0.0, MOST_ENERGY) if ratio > MOST_ENERGY else None


def torque_at_rest(shown_nm: float, bounds: WiringTestBounds) -> CheckResult | None:
    """0x6077 while none is demanded, on the mean: a torque of the drive's own, or a sensor that is off."""
    counts_nm = 0.0 if math.isnan(bounds.torque_count_nm) else ACTUAL_COUNTS * bounds.torque_count_nm
    allowed_nm = AT_REST_SHARE * bounds.limit_nm + counts_nm
    return (
        None
        if abs(shown_nm) <= allowed_nm
        else CheckResult(WiringOutcome.TORQUE_AT_REST, shown_nm, -allowed_nm, allowed_nm)
    )


def actual_torque(line: TorqueLine, bounds: WiringTestBounds) -> CheckResult | None:
    """0x6077 against the demand: sign and size."""
    slope = line.slope
    if line.most_nm < ACTUAL_COUNTS * bounds.torque_count_nm or math.isnan(slope):
        return None
    if ACTUAL_LOWEST <= slope <= ACTUAL_HIGHEST:
        return None
    return CheckResult(WiringOutcome.TORQUE_ACTUAL, slope, ACTUAL_LOWEST, ACTUAL_HIGHEST)


def friction_range(bounds: WiringTestBounds) -> tuple[float, float]:
    """Least and most friction, half of what lies between both break-aways, that fits what is known of the joint."""
    expected, limit_nm = bounds.friction_nm, bounds.limit_nm
    if math.isnan(expected):
        return LEAST_SHARE * limit_nm, math.inf
    return FRICTION_RATIO_LOW * expected, FRICTION_RATIO_HIGH * _expected_nm(bounds) + ALLOWED_SHARE * limit_nm


def _expected_nm(bounds: WiringTestBounds) -> float:
    """Torque of an expected break-away: friction, and what the ramp gets ahead while the inertia yields."""
    heavy_nm = 0.0 if math.isnan(bounds.inertia) else bounds.inertia * bounds.travel_rad * bounds.growth_per_s**2
    return bounds.friction_nm + heavy_nm


def scale_factor(bounds: WiringTestBounds) -> float:
    """By how much the torque may be too strong or too weak and still pass; infinite where nothing bounds it."""
    lowest_nm, highest_nm = friction_range(bounds)
    if math.isnan(bounds.friction_nm):
        return bounds.most_nm / lowest_nm
    expected_nm = _expected_nm(bounds)
    by_energy = math.inf if math.isnan(bounds.inertia) else MOST_ENERGY
    too_strong = expected_nm / lowest_nm if lowest_nm > 0.0 else by_energy
    too_weak = min(highest_nm, bounds.most_nm) / expected_nm if expected_nm > 0.0 else math.inf
    return max(too_strong, too_weak)


def friction(friction_nm: float, bounds: WiringTestBounds) -> CheckResult | None:
    """The size of the torque that moves the joint."""
    lowest_nm, highest_nm = friction_range(bounds)
    if friction_nm < lowest_nm:
        return CheckResult(WiringOutcome.TOO_EASY, friction_nm, lowest_nm, highest_nm)
    return (
        CheckResult(WiringOutcome.TOO_HEAVY, friction_nm, lowest_nm, highest_nm) if friction_nm > highest_nm else None
    )


# --- Motion over the last cycles -------------------------------------------------------------------------------------
# How far the joint has moved over the last cycles: what tells motion, its direction and rest from single counts. Used
# by the test of the wiring in the loop; a fixed number of floats, nothing grows.


#: Cycles over which rest is judged, and over which speed and direction are.
REST_CYCLES, SPEED_CYCLES = 20, 5

#: A way shorter than this share of the one before it: the joint slows down.
_SLOWER = 0.9


class RestWindow:
    """The last REST_CYCLES positions with their times."""

    def __init__(self, position_rad: float, time_s: float) -> None:
        self._positions = [position_rad] * (REST_CYCLES + 1)
        self._times = [time_s] * (REST_CYCLES + 1)
        self._at = 0
        self.count = 0  # cycles seen
        self._steps_rad = 0.0  # sum of the differences between neighbours

    def add(self, position_rad: float, time_s: float) -> None:
        """One cycle."""
        self._steps_rad += abs(position_rad - self._positions[self._at])
        self._at = (self._at + 1) % (REST_CYCLES + 1)
        oldest = self._at
        if self.count >= REST_CYCLES:
            following = (oldest + 1) % (REST_CYCLES + 1)
            self._steps_rad -= abs(self._positions[following] - self._positions[oldest])
        self._positions[oldest], self._times[oldest] = position_rad, time_s
        self.count += 1

    def way_rad(self, cycles: int) -> float:
        """From `cycles` ago to now, with its sign."""
        return self._positions[self._at] - self._positions[self._at - cycles]

    def speed_rad_s(self) -> float:
        """Mean over the last SPEED_CYCLES, with its sign; 0 before there are so many."""
        passed_s = self._times[self._at] - self._times[self._at - SPEED_CYCLES]
        return self.way_rad(SPEED_CYCLES) / passed_s if passed_s > 0.0 else 0.0

    def mean_rad(self) -> float:
        """Mean position of a joint that stands, without the sensor's noise; of one that moves, where it is."""
        mean = sum(self._positions) / (REST_CYCLES + 1)
        return mean if abs(self.way_rad(REST_CYCLES)) <= 4.0 * self.step_rad() else self._positions[self._at]

    def slows(self) -> bool:
        """The last SPEED_CYCLES brought a shorter way than those before them."""
        before = self._positions[self._at - SPEED_CYCLES] - self._positions[self._at - 2 * SPEED_CYCLES]
        return abs(self.way_rad(SPEED_CYCLES)) < _SLOWER * abs(before)

    def step_rad(self) -> float:
        """Mean difference between neighbours over REST_CYCLES: at rest, the sensor's noise."""
        return max(0.0, self._steps_rad) / REST_CYCLES
