"""What a CiA 402 drive keeps by itself, whatever servod does: its own limits and ways to stop. Off the control path.

Written at bring-up from the limits of the configuration, read back, and read again in turn while the axis runs. A limit
that stands tighter in the drive is the engineer's: it stays, is told, and counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from servod.common.errors import Unreachable
from servod.common.units import PER_MILLE, rad_per_count
from servod.runtime.fieldbus.cia import Obj301, Obj402
from servod.runtime.fieldbus.devices import SdoAbort, SdoAccess
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked, write_optional

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

#: The drive's own speed limit lies so far beyond limits.speed_rad_s, so that the loop's comes first.
SPEED_MARGIN = 1.1
#: A drive may round a limit to its own resolution: by one count, or by this share.
_ROUNDING = 0.01
_RPM = 60.0 / math.tau
#: 0x60A9 of drives whose velocities are revolutions a minute (CiA 402-2: unit 0xB4 per 0x47).
_UNIT_RPM = 0x00B44700
#: 0x6066: so long beyond 0x6065 in the modes that follow a position [ms].
_FOLLOWING_MS = 10
_HIGHEST = {Obj402.MAX_TORQUE: 0xFFFF, Obj402.POSITIVE_TORQUE_LIMIT: 0x7FFF, Obj402.NEGATIVE_TORQUE_LIMIT: 0x7FFF}
_TORQUES = tuple(_HIGHEST)
#: The ramp of each 0x605A that has one.
_RAMPS: dict[int, int] = {
    1: Obj402.PROFILE_DECELERATION,
    2: Obj402.QUICK_STOP_DECELERATION,
    5: Obj402.PROFILE_DECELERATION,
    6: Obj402.QUICK_STOP_DECELERATION,
}
_STAY = 5  # 0x605A from here on holds after the ramp of 4 less
_ABORT_FAULT, _ABORT_QUICK_STOP = 1, 3  # of 0x6007
#: 0x1029:1: a drive that lost its master leaves operational, so that a master that comes back commands nothing.
_LEAVE_OPERATIONAL = 0
Guard = tuple[int, int, int]  # index, sub-index, value


@dataclass
class Guards:
    """What stands in the drive: `kept` is read again in turn, `found` is put back at an orderly end."""

    sdo: SdoAccess
    kept: list[Guard] = field(default_factory=list)
    found: list[Guard] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def exact(self, index: int, subindex: int, value: int) -> bool:
        """An object that must read exactly this; False when the drive lacks it. Raises SdoAbort, Unreachable."""
        if not write_optional(self.sdo, index, subindex, value):
            return False
        self.kept.append((index, subindex, value))
        return True

    def limit(
        self, index: int, subindex: int, wanted: int, lower: bool = False, unset: int | None = None
    ) -> int | None:
        """A limit, upper or `lower`; what stands there in the end, None when the drive lacks it. One that reads `unset`
        was never set: makers take that for no limit or for standing still, so it is never a tighter one.

        Raises Unreachable when the drive takes it and keeps something else than its own rounding of it.
        """
        name, present = f"0x{index:04X}:{subindex}", read_optional(self.sdo, index, subindex)
        if present is None:
            self.notes.append(f"no {name}: the drive does not limit this by itself")
            return None
        tighter = present > wanted if lower else present < wanted
        if tighter and present != unset:
            self.notes.append(f"{name} stands at {present}, tighter than {wanted}: it stays")
        elif present != wanted:
            present = self._write_limit(name, (index, subindex, wanted), present)
        self.kept.append((index, subindex, present))
        return present

    def _write_limit(self, name: str, guard: Guard, before: int) -> int:
        index, subindex, wanted = guard
        try:
            self.sdo.write(index, subindex, wanted)
        except SdoAbort as abort:
            self.notes.append(f"{name} stays at {before}, not {wanted}: refused, 0x{abort.code:08X}; it guards nothing")
            return before
        self.found.append((index, subindex, before))
        read = self.sdo.read(index, subindex)
        if abs(read - wanted) > max(1.0, _ROUNDING * abs(wanted)):
            raise Unreachable(f"object {name}: wrote {wanted}, device reads {read}")
        if read != wanted:
            self.notes.append(f"{name}: the drive rounds {wanted} to {read}")
        return read


def write_stops(guards: Guards, config: AxisConfig) -> bool:
    """The drive's ways to stop; whether it reacts to a lost heartbeat by 0x6007.

    Raises Unreachable for a drive that cannot be told how to stop: then no stopping distance holds.
    """
    amplifier = config.amplifier
    option = amplifier.quick_stop_option
    rows = ((Obj402.QUICK_STOP_OPTION, option), (Obj402.FAULT_REACTION_OPTION, option - 4 * (option >= _STAY)))
    for index, value in rows:
        if not _takes(guards, index, value):
            if not amplifier.unguarded:
                raise Unreachable(
                    f"amplifier node {amplifier.node_id}: object 0x{index:04X} does not take {value}, so how the drive "
                    "stops is not known; choose amplifier.quick_stop_option as its manual allows, or, with the way it "
                    "stops tried by hand, amplifier.unguarded: true"
                )
            guards.notes.append(f"no 0x{index:04X}: the drive stops by its own way (amplifier.unguarded)")
    if not guards.exact(Obj301.ERROR_BEHAVIOUR, 1, _LEAVE_OPERATIONAL):
        guards.notes.append("no 0x1029:1: what the node does after a communication error is its maker's choice")
    # With an option that stays in quick stop active, a quick stop that nobody ends would hold with torque for ever.
    # With a brake by output that is wanted: while the drive holds, the supervisor that survived its loop closes it.
    stays = option >= _STAY and amplifier.brake.by != "output"
    holds = stays and amplifier.heartbeat_reaction == _ABORT_QUICK_STOP
    if guards.exact(Obj402.ABORT_CONNECTION, 0, _ABORT_FAULT if holds else amplifier.heartbeat_reaction):
        return True
    guards.notes.append("no 0x6007: the drive's own reaction to a lost heartbeat applies")
    return False


def _takes(guards: Guards, index: int, value: int) -> bool:
    try:
        return guards.exact(index, 0, value)
    except SdoAbort:
        return False


def write_limits(guards: Guards, config: AxisConfig, rated_torque_nm: float) -> float:
    """The drive's own limits of torque, speed and following error; the most torque at the joint, in N*m, that it and
    limits.torque_nm leave.

    `rated_torque_nm`: of the motor (0x6076).
    """
    limits, amplifier = config.limits, config.amplifier
    per_mille_nm = rated_torque_nm * amplifier.gear_ratio / PER_MILLE
    least = math.inf
    for index in _TORQUES:  # the least of them is what the drive gives
        wanted = min(math.ceil(limits.torque_nm / per_mille_nm - 1e-9), _HIGHEST[index])
        stands = guards.limit(index, 0, wanted)
        least = least if stands is None else min(least, stands)
    counts = amplifier.gear_ratio / rad_per_count(amplifier.counts_per_turn)  # for each rad of the joint
    speed = SPEED_MARGIN * limits.speed_rad_s
    rpm = math.ceil(speed * amplifier.gear_ratio * _RPM)
    guards.limit(Obj402.MAX_MOTOR_SPEED, 0, rpm, unset=0)
    in_rpm = read_optional(guards.sdo, Obj402.VELOCITY_UNIT) == _UNIT_RPM
    guards.limit(Obj402.MAX_PROFILE_VELOCITY, 0, _unsigned(rpm if in_rpm else math.ceil(speed * counts)), unset=0)
    guards.limit(Obj402.FOLLOWING_WINDOW, 0, _unsigned(math.ceil(limits.following_error_rad * counts)))
    guards.limit(Obj402.FOLLOWING_TIME_OUT, 0, _FOLLOWING_MS)
    return min(least * per_mille_nm, limits.torque_nm)


def write_ramp(guards: Guards, config: AxisConfig, in_counts: bool) -> None:
    """The ramp that a stop is reckoned with (servod.formats.stopping); one that is steeper in the drive stays.

    `in_counts`: the drive's unit is that of 0x6064 per s^2. Raises Unreachable for a drive that keeps a gentler one.
    """
    obj = _RAMPS.get(config.amplifier.quick_stop_option)
    ramp = config.stopping.deceleration_rad_s2
    if obj is None or (in_counts and ramp is None):
        return
    if not in_counts or ramp is None:
        present = read_optional(guards.sdo, obj)
        if present is not None:  # whatever it means, nobody may change it
            guards.kept.append((int(obj), 0, present))
        reckoned = "no ramp" if ramp is None else f"{ramp:.4g} rad/s^2 at the joint, which it must be at least"
        guards.notes.append(
            f"0x{obj:04X} is in the maker's unit and reads {present}: the stop is reckoned with {reckoned}"
        )
        return
    amplifier = config.amplifier
    wanted = _unsigned(math.ceil(ramp * amplifier.gear_ratio / rad_per_count(amplifier.counts_per_turn)))
    stands = guards.limit(obj, 0, wanted, lower=True)
    if stands is None or stands < (1.0 - _ROUNDING) * wanted:
        raise Unreachable(
            f"amplifier node {amplifier.node_id}: object 0x{obj:04X} does not take {wanted}, the ramp of {ramp:.4g} "
            "rad/s^2 that the stop is reckoned with; state a ramp that it takes, stopping.deceleration_rad_s2"
        )


def _unsigned(value: int) -> int:
    return min(value, 0xFFFFFFFE)  # all ones switches a limit off


def write_position_limits(guards: Guards, config: AxisConfig, joint_rad: float) -> None:
    """0x607D: the position limits as the motor counts, with the joint at `joint_rad` now; wider by what the two sensors
    may drift apart, so that the loop's own limits come first."""
    limits, amplifier = config.limits, config.amplifier
    counts = amplifier.position_direction * amplifier.gear_ratio / rad_per_count(amplifier.counts_per_turn)
    here = guards.sdo.read(Obj402.POSITION_ACTUAL)
    margin = limits.encoder_mismatch_rad
    ends = (limits.position_min_rad - margin, limits.position_max_rad + margin)
    low, high = sorted(round(here + (end - joint_rad) * counts) for end in ends)
    both = {read_optional(guards.sdo, Obj402.POSITION_LIMITS, subindex) for subindex in (1, 2)}
    unset = 0 if both == {0} else None  # a range without width
    # The drive refuses a lower end above the upper one, so of a range that was never set that goes first which is free.
    ends_counts = [(1, max(low, -0x80000000), True), (2, min(high, 0x7FFFFFFF), False)]
    for subindex, counts_wanted, lower in ends_counts if low <= 0 else reversed(ends_counts):
        guards.limit(Obj402.POSITION_LIMITS, subindex, counts_wanted, lower, unset)


def put_back(sdo: SdoAccess, found: list[Guard]) -> None:
    """The drive's own limits as they were found, the last one first."""
    for index, subindex, value in reversed(found):
        write_checked(sdo, index, subindex, value)
