"""What a stop of the configured joint takes: worst speed, travel and time, and the limits narrowed so that they hold.

Beside the data path, before the bring-up: from the configuration, the axis model that it names, and how soon the drive
reacts by itself. What cannot be kept is refused. The loop gets plain numbers (servod.kernels.stopping).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypedDict

from servod.common.errors import BadInput
from servod.formats.config import AxisConfig
from servod.formats.config_wire import quick_stop_stays
from servod.formats.joint_bounds import JointBounds, joint_of
from servod.kernels.stopping import OVERSPEED, RECKONED_OVERSPEED, REST_S, StopFacts, both_ways

#: A ramp that nobody states takes so much of the torque that the heaviest joint leaves for it.
_RAMP_SHARE = 0.8
#: SYNC and filter: the loop's look at the joint is a cycle old, its command acts a cycle later, the drive's tick is the
#: third.
CYCLES_BEHIND = 3
#: Torque is gone, or only holds a joint at rest, within these times [s]: where the drive misses its commands sooner
#: than the third, and else.
_WITHIN_S, _WITHIN_BY_HEARTBEAT_S, _SOON_S = 0.06, 0.3, 0.03
_BISECTIONS = 60
#: A load that falls may take the rest of the speed that is stated.
_LEAST_SHARE = 0.2
#: 0x605A, 0x6007: without torque, with the ramps, and with windings shorted.
_OFF, _RAMPS, _CURRENT_LIMIT, _REACTS_OFF, _HOLDS = 0, (1, 2), 3, 2, 3


class StoppingStatus(TypedDict):
    """The statement for the status document, SI units; `coasts_rad` None where the load drives the joint on, `narrowed`
    and `notes` in sentences."""

    reaction_s: float
    time_s: float
    held_s: float
    speed_rad_s: float
    travel_rad: float
    unbraked_rad: float
    coasts_rad: float | None
    energy_j: float
    limit_rad_s: float
    deceleration_rad_s2: float
    torque_at_rest_nm: float
    torque_at_speed_nm: float
    narrowed: list[str]
    notes: list[str]


@dataclass(frozen=True)
class Stopping:
    """The stop that is stated and kept. Times in s from the loss to the torque's end, speeds and ways at their worst.

    `coasts_rad` is the way where the drive does not brake (STO, unusable power stage, disabled at a fault); infinite
    where the load drives the joint on. `unbraked_rad` is the way until the torque is gone then. In the last
    `held_s` of `time_s` torque only holds the joint that has come to rest. `notes` are for people.
    """

    facts: StopFacts
    reaction_s: float
    time_s: float
    held_s: float
    speed_rad_s: float
    travel_rad: float
    unbraked_rad: float
    coasts_rad: float
    energy_j: float
    torque_at_rest_nm: float
    torque_at_speed_nm: float
    ramp_down_s: float
    narrowed: tuple[str, ...]
    notes: tuple[str, ...]

    def lines(self) -> list[str]:
        """Everything in sentences, for the log."""
        return [*self.statement(), *(f"stopping: {text}" for text in self.narrowed)]

    def statement(self) -> list[str]:
        """What a stop takes, in sentences."""
        facts = self.facts
        ramp = f"ramp {facts.deceleration_rad_s2:.3g} rad/s^2" if facts.deceleration_rad_s2 else "no ramp"
        rests = (
            f"the joint is at rest within {1e3 * (self.time_s - self.held_s):.0f} ms and torque, which holds it on "
            "purpose until then, is"
            if self.held_s and facts.deceleration_rad_s2
            else "torque is"
        )
        found = [
            f"stopping: after a loss of the master {rests} gone within {1e3 * self.time_s:.0f} ms, at "
            f"{self.speed_rad_s:.3g} rad/s and after {self.travel_rad:.3g} rad at most, {self.energy_j:.2g} J "
            f"(reaction {1e3 * self.reaction_s:.0f} ms, {ramp})"
        ]
        if math.isinf(self.coasts_rad):
            found.append(
                f"stopping: without the drive the joint does not rest by itself: a load of {facts.load_nm:.3g} N*m is "
                f"not held by {facts.friction_nm:.3g} N*m of friction; it takes a brake or a stop"
            )
        else:
            found.append(f"stopping: without the drive the joint coasts for up to {self.coasts_rad:.3g} rad")
        return [*found, *(f"stopping: {text}" for text in self.notes)]

    def document(self) -> StoppingStatus:
        """For the status document and `--json`."""
        facts = self.facts
        return {
            "reaction_s": self.reaction_s,
            "time_s": self.time_s,
            "held_s": self.held_s,
            "speed_rad_s": self.speed_rad_s,
            "travel_rad": self.travel_rad,
            "unbraked_rad": self.unbraked_rad,
            "coasts_rad": self.coasts_rad if math.isfinite(self.coasts_rad) else None,
            "energy_j": self.energy_j,
            "limit_rad_s": facts.speed_rad_s,
            "deceleration_rad_s2": facts.deceleration_rad_s2,
            "torque_at_rest_nm": self.torque_at_rest_nm,
            "torque_at_speed_nm": self.torque_at_speed_nm,
            "narrowed": list(self.narrowed),
            "notes": list(self.notes),
        }


#: What a drive takes for rest, rad/s: the joint coasts on from there by its friction when the torque goes.
_CREEPS_RAD_S = 0.012
#: The drive's threshold of rest (0x606F) counts at the motor, so behind a gear it is so many times finer at the joint,
#: and what is left of the speed decays with the drive's lag: 8, 23, 32, 40 and 48 ms more at 10, 30, 100, 300 and 1000
#: on the virtual axis (lag 6 ms).
_DECAYS_LAGS = 1.2

#: What is said where nothing is known of the joint.
UNKNOWN = (
    "stopping: not computed: neither `model`, stopping.least_inertia, wiring_proof.inertia nor the gain set's design "
    "tells of the joint; nothing keeps its stopping distance inside the limits"
)


def with_stopping(
    config: AxisConfig, reaction_s: float, writes_ramp: bool = True
) -> tuple[AxisConfig, Stopping | None]:
    """`config` with limits.speed_rad_s narrowed where it must be and the ramp that the drive shall have, and the
    statement; None where nothing is known.

    `reaction_s`: how long the drive goes on with its last command when the master is dead; `writes_ramp`: its ramp is
    written and read back, else none is reckoned with but one that stopping.deceleration_rad_s2 states. Raises BadInput
    for limits that cannot be kept at any speed, with how much they lack.
    """
    joint = joint_of(config)
    if joint is None:
        return config, None
    stopping = stated(config, joint, reaction_s, writes_ramp)
    facts = stopping.facts
    limits = config.limits.model_copy(update={"speed_rad_s": facts.speed_rad_s, "ramp_down_s": stopping.ramp_down_s})
    ramp = config.stopping.model_copy(update={"deceleration_rad_s2": facts.deceleration_rad_s2 or None})
    return config.model_copy(update={"limits": limits, "stopping": ramp}), stopping


def stated(config: AxisConfig, joint: JointBounds, reaction_s: float, writes_ramp: bool = True) -> Stopping:
    """The statement for a joint. Raises BadInput for limits that cannot be kept."""
    within_s = config.stopping.within_s or (_WITHIN_S if reaction_s <= _SOON_S else _WITHIN_BY_HEARTBEAT_S)
    widest = _facts(config, joint, reaction_s, writes_ramp)
    _check_load(widest, min(config.limits.torque_nm, joint.brake_nm))
    facts = _largest(widest, within_s)
    _check_kept(facts)
    ways, speed_rad_s, end_rad_s = both_ways(facts), facts.speed_rad_s, _end_rad_s(facts)
    at_rest_nm = min(way.most_torque_nm(0.0, math.inf) for way in ways)
    at_speed_nm = min(way.most_torque_nm(speed_rad_s, math.inf) for way in ways)
    narrowed, held_s = [], _held_s(config)
    if speed_rad_s < widest.speed_rad_s:
        done = "the joint is at rest" if held_s and facts.deceleration_rad_s2 else "torque is gone"
        narrowed.append(
            f"limits.speed_rad_s {widest.speed_rad_s:g} is narrowed to {speed_rad_s:.3g} rad/s, so that {done} "
            f"within {1e3 * within_s:g} ms (stopping.within_s) and the joint rests inside its range, with its load"
        )
    if at_speed_nm < facts.torque_nm:
        narrowed.append(
            f"limits.torque_nm {facts.torque_nm:g} towards the motion is narrowed to "
            f"{min(at_rest_nm, facts.torque_nm):.3g} N*m at rest and {at_speed_nm:.3g} N*m at {speed_rad_s:.3g} rad/s, "
            f"which the joint may have for {1e3 * facts.hold_s:.0f} ms"
        )
    # A loop that lost its supervisor brakes and ramps; or, where the law runs away, the drive stops it after braking.
    behind_s, by_drive_s = CYCLES_BEHIND * config.cycle.period_us * 1e-6, _time_s(facts) - facts.hold_s
    most_ramp_s = min(0.5 * (within_s - 2.0 * behind_s), within_s - behind_s - by_drive_s)
    ramp_down_s = min(config.limits.ramp_down_s, max(most_ramp_s, 1e-3))
    if ramp_down_s < config.limits.ramp_down_s:
        narrowed.append(
            f"limits.ramp_down_s {config.limits.ramp_down_s:g} is narrowed to {ramp_down_s:.3g} s: a loop that lost "
            f"its supervisor brakes for so long, then comes its ramp, or the drive's ({1e3 * by_drive_s:.0f} ms)"
        )
    # A law that runs away does not brake: a loop that lost its supervisor lets it for that long, within the limits and
    # the range, and then the drive stops it.
    alone_rad = speed_rad_s * (ramp_down_s + behind_s) + max(
        end_rad_s * (facts.lag_s + 0.5 * end_rad_s / way.deceleration_rad_s2) for way in ways
    )
    unbraked_rad = max(way.behind * speed_rad_s + way.ahead * end_rad_s for way in ways)
    coasts_rad = max(way.coasting_rad(end_rad_s) for way in ways)
    creeps_rad = max(way.coasting_rad(_CREEPS_RAD_S) for way in ways) if facts.deceleration_rad_s2 else 0.0
    return Stopping(
        facts,
        reaction_s,
        max(_time_s(facts), 2.0 * ramp_down_s + behind_s, ramp_down_s + behind_s + by_drive_s) + held_s,
        held_s,
        end_rad_s,
        max(
            min(alone_rad, facts.position_max_rad - facts.position_min_rad),
            *(way.travel_rad(speed_rad_s, end_rad_s) for way in ways),
        )
        + (creeps_rad if math.isfinite(creeps_rad) else 0.0),  # what no friction holds is told apart
        unbraked_rad,
        unbraked_rad + coasts_rad,
        0.5 * joint.torque_factor * facts.most_inertia * end_rad_s * end_rad_s,
        min(at_rest_nm, facts.torque_nm),
        min(at_speed_nm, facts.torque_nm),
        ramp_down_s,
        tuple(narrowed),
        (f"the joint is as {joint.source}", *joint.assumed, *_holds(config)),
    )


def _facts(config: AxisConfig, joint: JointBounds, reaction_s: float, writes_ramp: bool) -> StopFacts:
    limits, period_s = config.limits, config.cycle.period_us * 1e-6
    filter_s = 1.0 / (2.0 * math.pi * config.encoder.velocity_cutoff_hz)
    # What is not heard meanwhile, the limits reckon with.
    hold_s = reaction_s + CYCLES_BEHIND * period_s + filter_s + joint.late_s
    load_nm = max(-joint.load_min_nm, joint.load_max_nm)
    most_rad_s2 = (min(limits.torque_nm, joint.brake_nm) + joint.friction_nm - load_nm) / joint.most_inertia
    ramp_rad_s2 = _ramp(config, most_rad_s2, writes_ramp)
    return StopFacts(
        joint.least_inertia,
        joint.most_inertia,
        joint.friction_nm,
        joint.viscous,
        joint.load_min_nm,
        joint.load_max_nm,
        limits.torque_nm,
        limits.speed_rad_s,
        RECKONED_OVERSPEED * limits.speed_rad_s,
        limits.position_min_rad,
        limits.position_max_rad,
        hold_s,
        max(config.stopping.drive_lag_s, joint.late_s),
        ramp_rad_s2,
    )


def _ramp(config: AxisConfig, most_rad_s2: float, writes_ramp: bool) -> float:
    """The drive's deceleration after a loss of the master; 0 where its options switch the torque off, and where nobody
    knows its ramp: one that is too gentle is worse than none by time only, and the way is that of coasting at most."""
    option, stated_rad_s2 = config.amplifier.quick_stop_option, config.stopping.deceleration_rad_s2
    if config.amplifier.heartbeat_reaction == _REACTS_OFF or option == _OFF:
        return 0.0
    kind = option - 4 if quick_stop_stays(option) else option
    if stated_rad_s2 is not None:
        return min(stated_rad_s2, most_rad_s2)
    if kind in _RAMPS and not writes_ramp:
        return 0.0
    return _RAMP_SHARE * most_rad_s2 if kind in (*_RAMPS, _CURRENT_LIMIT) else 0.0


def _holds(config: AxisConfig) -> list[str]:
    """What the stated time is not about."""
    amplifier, notes = config.amplifier, []
    if config.heartbeat.command_deadline_ms == 0:
        notes.append(
            "commands alone lost, the master alive: not in these figures, the drive has no deadline for them "
            "(heartbeat.command_deadline_ms 0)"
        )
    stays = quick_stop_stays(amplifier.quick_stop_option) and amplifier.heartbeat_reaction == _HOLDS
    if amplifier.brake.by == "output" and stays:
        notes.append(
            "loop and supervisor dead: at rest the drive holds the joint with torque until it is switched off, since "
            "nobody closes the brake (amplifier.heartbeat_reaction 3 with quick_stop_option from 5 on)"
        )
    return notes


def _held_s(config: AxisConfig) -> float:
    """How long the torque holds the joint that has come to rest: until the drive has seen it, behind a gear; until its
    brake is closed, or servod has seen the rest of a drive that stays in quick stop active (0x605A from 5 on)."""
    brake, stays = config.amplifier.brake, quick_stop_stays(config.amplifier.quick_stop_option)
    seen_s = REST_S if stays or brake.by == "output" else 0.0
    finer = math.log(max(config.amplifier.gear_ratio, 1.0))
    return seen_s + (brake.engage_s if brake.by != "none" else 0.0) + _DECAYS_LAGS * config.stopping.drive_lag_s * finer


def _time_s(facts: StopFacts) -> float:
    """Until the torque is gone: held, ramp, and what the drive takes to see that the joint rests."""
    if not facts.deceleration_rad_s2:
        return facts.hold_s
    return facts.hold_s + _end_rad_s(facts) / facts.deceleration_rad_s2 + 2.0 * facts.lag_s


def _end_rad_s(facts: StopFacts) -> float:
    """The speed that is stated."""
    return OVERSPEED / RECKONED_OVERSPEED * facts.top_rad_s


def _at(facts: StopFacts, speed_rad_s: float) -> StopFacts:
    """The limits for a speed: a load that falls must not outrun it until the drive stops it, so it stops before."""
    top_rad_s = RECKONED_OVERSPEED * speed_rad_s
    falling_rad_s = min(way.most_speed_rad_s(top_rad_s) for way in both_ways(facts))
    return facts._replace(speed_rad_s=min(speed_rad_s, falling_rad_s), top_rad_s=top_rad_s)


def _fits(facts: StopFacts, within_s: float) -> bool:
    range_rad = facts.position_max_rad - facts.position_min_rad
    if not facts.deceleration_rad_s2 and any(way.coasting_rad_s2 == 0.0 for way in both_ways(facts)):
        return False
    furthest_rad = max(way.travel_rad(facts.speed_rad_s, _end_rad_s(facts)) for way in both_ways(facts))
    return _time_s(facts) <= within_s and furthest_rad <= range_rad


def _largest(facts: StopFacts, within_s: float) -> StopFacts:
    """The limits at the largest speed that fits, at most the configured one. Raises BadInput where none does."""
    if _fits(_at(facts, facts.speed_rad_s), within_s):
        return _at(facts, facts.speed_rad_s)
    low, high = 0.0, facts.speed_rad_s
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _fits(_at(facts, middle), within_s) else (low, middle)
    if low <= 1e-6 * facts.speed_rad_s:
        least_s = _time_s(_at(facts, 0.0))
        if least_s > within_s:
            found, allowed = f"{within_s:g} s", f"at least {least_s:.3g} s, which the drive takes to react and to stop"
            raise BadInput("stopping.within_s", found, allowed)
        raise BadInput(
            "limits.speed_rad_s",
            f"{facts.speed_rad_s:g} rad/s with a drive that does not brake (0x605A, 0x6007) and no friction that would",
            "a drive that brakes when its master is lost, by a ramp that is written or stated "
            "(stopping.deceleration_rad_s2)",
        )
    return _at(facts, low)


def _check_load(facts: StopFacts, brake_nm: float) -> None:
    """The drive must be able to brake against the load, with `brake_nm` at most."""
    lacks_nm = facts.load_nm - facts.friction_nm - brake_nm
    if lacks_nm >= 0.0:
        allowed = f"more than {lacks_nm + brake_nm:.3g} N*m, with which a load of {facts.load_nm:.3g} N*m stops"
        raise BadInput("limits.torque_nm", f"{brake_nm:g} N*m", allowed)


def _check_kept(facts: StopFacts) -> None:
    """What the narrowed limits leave must hold the load, and a falling load must leave a speed to move with."""
    up, down = both_ways(facts)
    for way, back in ((up, down), (down, up)):
        if facts.speed_rad_s < _LEAST_SHARE * facts.top_rad_s:
            gained_rad_s = way.unpowered_rad_s(0.0)
            raise BadInput(
                "limits.speed_rad_s",
                f"{_end_rad_s(facts):.3g} rad/s at most, of which the load alone makes {gained_rad_s:.3g} rad/s in the "
                f"{1e3 * facts.hold_s:.0f} ms until the drive stops it",
                f"at most {1.0 - _LEAST_SHARE:.0%} of it: a quicker reaction, less load, or a longer stopping.within_s",
            )
        held_nm, needed_nm = way.most_torque_nm(0.0, math.inf), back.push_nm - facts.friction_nm
        if held_nm <= max(needed_nm, 0.0):
            raise BadInput(
                "limits.torque_nm",
                f"{held_nm:.3g} N*m for {1e3 * facts.hold_s:.0f} ms, which end at {facts.top_rad_s:.3g} rad/s",
                f"more than the {max(needed_nm, 0.0):.3g} N*m that hold the load: a quicker reaction, a higher "
                "limits.speed_rad_s, or less load",
            )
