"""CiA 402 amplifier: the set-up face. Off the control path: states the wanted PDOs, writes options, reads scalings.

The order inside `configure` matters: nothing is written to a powered drive; the mode is checked for support before it
is chosen, and chosen before the node becomes operational, because several drives refuse otherwise (drivers/quirks.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from servod.common.errors import BadInput, Unreachable
from servod.common.units import PER_MILLE, rad_per_count
from servod.drivers.cia402_state import quick_stop_stays
from servod.drivers.cia402_target import target_type
from servod.drivers.pdo_codec import slow_syncs
from servod.drivers.quirks import CommandDeadline, Presence, Quirks, load_quirks
from servod.runtime.fieldbus.cia import RPDO_BASE, TPDO_BASE, Obj301, Obj402, decode_status_word
from servod.runtime.fieldbus.devices import (
    EVENT_DRIVEN,
    DriveInput,
    DriveState,
    Mode,
    NodePlan,
    PdoEntry,
    PdoMap,
    SdoAbort,
    SdoAccess,
)
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked, write_optional

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig, BrakeConfig, InputsConfig

#: Bit of 0x6502 for each mode that this driver can run.
SUPPORTED_MODE_BIT = {
    Mode.PROFILE_POSITION: 0,
    Mode.CYCLIC_SYNC_POSITION: 7,
    Mode.CYCLIC_SYNC_VELOCITY: 8,
    Mode.CYCLIC_SYNC_TORQUE: 9,
}
#: By events where a drive knows no transmission type but 1 and 255, and with inputs: an emergency stop comes at once,
#: without SYNC too. Drives need not send the PDO when an input changes: so often they send it anyway.
_SLOW_TIMER_MS, _INPUTS_TIMER_MS = 100, 10
#: Bits of 0x1001: current, voltage, temperature (CiA 301).
_POWER_ERRORS = 0x0E


def amplifier_pdos(
    node_id: int,
    mode: Mode,
    command_deadline_ms: int,
    slow_syncs: int,
    with_inputs: bool = False,
    with_outputs: bool = False,
) -> tuple[PdoMap, ...]:
    """The three PDOs of the amplifier: command, synchronous feedback, and the rest with every `slow_syncs`-th SYNC
    or, with inputs, by events.

    The command's deadline guards against a dead loop and against commands alone that do not arrive, where the drive
    stops at it (drivers/quirks.py); the heartbeat guards in any case. The EMCY is a fault of the axis in any case.
    """
    target = target_type(mode)
    outputs = (PdoEntry(Obj402.DIGITAL_OUTPUTS, 1, 32),) if with_outputs else ()
    command = (PdoEntry(Obj402.CONTROL_WORD, 0, 16), PdoEntry(target.index, 0, target.bits), *outputs)
    feedback = (
        PdoEntry(Obj402.STATUS_WORD, 0, 16),
        PdoEntry(Obj402.POSITION_ACTUAL, 0, 32),
        PdoEntry(Obj402.TORQUE_ACTUAL, 0, 16),
    )
    inputs = (PdoEntry(Obj402.DIGITAL_INPUTS, 0, 32),) if with_inputs else ()
    slow = (PdoEntry(Obj402.MODE_DISPLAY, 0, 8), PdoEntry(Obj402.ERROR_CODE, 0, 16), *inputs)
    slow_type, slow_ms = (EVENT_DRIVEN, _INPUTS_TIMER_MS) if with_inputs else (slow_syncs, _SLOW_TIMER_MS)
    return (
        PdoMap(True, 1, RPDO_BASE[0] + node_id, 1, command, event_timer_ms=command_deadline_ms),
        PdoMap(False, 1, TPDO_BASE[0] + node_id, 1, feedback),
        PdoMap(False, 2, TPDO_BASE[1] + node_id, slow_type, slow, event_timer_ms=slow_ms),
    )


def interpolation_period(period_us: int, quirks: Quirks) -> tuple[int, int]:
    """(value, exponent) of 0x60C2 for a cycle: period = value * 10**exponent s, value in 8 bits, exactly.

    Raises BadInput when the drive takes no such pair.
    """
    for exponent in quirks.interpolation_exponents:
        unit_us = 10 ** (6 + exponent)
        if period_us % unit_us == 0 and 0 < period_us // unit_us <= 255:
            return period_us // unit_us, exponent
    raise BadInput("cycle.period_us", period_us, f"a period that 0x60C2 of {quirks.maker} can express, e.g. 1000")


def input_rows(inputs: InputsConfig) -> list[tuple[int, int, int]]:
    """(servod.runtime.fieldbus.devices.DriveInput, mask of 0x60FD, its value when active) of each input to read."""
    named = (
        (DriveInput.ESTOP, inputs.estop_bit, inputs.estop_active),
        (DriveInput.STO, inputs.sto_bit, inputs.sto_active),
    )
    return [(int(flag), 1 << bit, 0 if level == "low" else 1 << bit) for flag, bit, level in named if bit is not None]


def brake_outputs(brake: BrakeConfig) -> tuple[int, int] | None:
    """Values of 0x60FE:1 that (close, open) the brake; their difference is the mask. None where it is no output's."""
    if brake.output_bit is None:
        return None
    bit = 1 << brake.output_bit
    return (0, bit) if brake.output_engages == "low" else (bit, 0)


class AmplifierSetup:
    """Set-up face of a CiA 402 amplifier (servod.runtime.fieldbus.devices.Setup)."""

    def __init__(self, config: AxisConfig, mode: Mode = Mode.CYCLIC_SYNC_TORQUE) -> None:
        self._config, self._amplifier = config, config.amplifier
        self._period_us = config.cycle.period_us
        self._mode = mode
        self._quirks = load_quirks(config.quirks)
        missing = self._quirks.command_deadline is CommandDeadline.MISSING
        self._command_deadline_ms = 0 if missing else config.command_deadline_ms
        self._notes: list[str] = []

    def plan(self) -> NodePlan:
        """The wanted mapping and the facts of the configuration; raises BadInput for what the drive cannot map."""
        amplifier = self._amplifier
        inputs = input_rows(amplifier.inputs)
        brake = brake_outputs(amplifier.brake)
        syncs, deadline_ms = slow_syncs(self._period_us), self._command_deadline_ms
        pdos = amplifier_pdos(amplifier.node_id, self._mode, deadline_ms, syncs, bool(inputs), brake is not None)
        longest = max(len(pdo.entries) for pdo in pdos)
        if longest > self._quirks.max_pdo_entries:
            raise BadInput("amplifier.quirks", self._config.quirks, f"a drive that maps {longest} objects in one PDO")
        facts: dict[str, Any] = {
            "mode": int(self._mode),
            "period_s": self._period_us * 1e-6,
            "counts_per_turn": amplifier.counts_per_turn,
            "gear_ratio": amplifier.gear_ratio,
            "position_direction": amplifier.position_direction,
            "torque_direction": amplifier.torque_direction,
            "quick_stop_option": amplifier.quick_stop_option,
            "inputs": inputs,
            "sto_error": amplifier.inputs.sto_error or 0,
            "brake": brake,
            "quirks": self._config.quirks,
            "deadline_stops": self._quirks.command_deadline is CommandDeadline.STOPS,
            "writes_ramp": self._quirks.deceleration,
            "pdo_pairs": self._quirks.pdo_pairs,
            "reset_communication_at_start": self._quirks.reset_communication_at_start,
            "reset_communication_after": sorted(self._quirks.reset_communication_after),
        }
        if amplifier.rated_torque_mnm is not None:
            facts["rated_torque_nm"] = amplifier.rated_torque_mnm * 1e-3
        return NodePlan(amplifier.driver, amplifier.node_id, pdos, facts)

    def inspect(self, sdo: SdoAccess) -> None:
        """Refuse a powered drive: it may be another axis's, or this one's whose heartbeat time-out still runs."""
        state = decode_status_word(sdo.read(Obj402.STATUS_WORD))
        if state is DriveState.QUICK_STOP_ACTIVE and quick_stop_stays(self._amplifier.quick_stop_option):
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id} holds the joint in quick stop active (0x605A), and no "
                "time-out ends that: support the load, then switch the drive's power off and on, and start again"
            )
        if state.powered:
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id} is powered ({state.name}): "
                "nothing is sent to it; disable it or wait for its heartbeat time-out, then start again"
            )

        register = sdo.read(Obj301.ERROR_REGISTER)
        if register & _POWER_ERRORS and state is not DriveState.FAULT:
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id} tells of an error of current, voltage or temperature "
                f"(0x1001 = 0x{register:02X}) that no fault state shows: switch it off and on, and see 0x1003"
            )

    def configure(self, sdo: SdoAccess) -> NodePlan:
        """Write options and mode, read scalings; the node is pre-operational. Raises Unreachable, BadInput."""
        self._notes = []
        self.inspect(sdo)
        self._check_preconditions(sdo)
        self._check_mode_supported(sdo)
        plan = self.plan()
        plan.facts["rated_torque_nm"] = self._rated_torque_nm(sdo)
        plan.facts["polarity"] = self._polarity(sdo)
        guards = Guards(sdo, notes=self._notes)
        plan.facts["deadline_stops"] = self._deadline_stops(guards)
        plan.facts["heartbeat_reaction"] = write_stops(guards, self._config)
        plan.facts["most_torque_nm"] = write_limits(guards, self._config, plan.facts["rated_torque_nm"])
        write_ramp(guards, self._config, self._quirks.deceleration)
        plan.facts["guards"], plan.facts["guards_found"] = guards.kept, guards.found
        self._write_interpolation_period(sdo)
        plan.facts["brake"] = self._take_brake(sdo)
        write_checked(sdo, Obj402.MODE, 0, int(self._mode))
        plan.facts["notes"] = list(self._notes)
        return plan

    def _check_preconditions(self, sdo: SdoAccess) -> None:
        for wanted in self._quirks.preconditions:
            read = sdo.read(wanted.index, wanted.subindex)
            if read & wanted.mask != wanted.value:
                where = f"amplifier node {self._amplifier.node_id} ({self._quirks.maker})"
                raise Unreachable(
                    f"{where}: object 0x{wanted.index:04X}:{wanted.subindex} reads {read}; {wanted.remedy}"
                )

    def _check_mode_supported(self, sdo: SdoAccess) -> None:
        supported = sdo.read(Obj402.SUPPORTED_MODES)
        if not supported & 1 << SUPPORTED_MODE_BIT[self._mode]:
            node = self._amplifier.node_id
            raise Unreachable(f"amplifier node {node}: {self._mode.name} not supported (0x6502 = 0x{supported:08X})")

    def _deadline_stops(self, guards: Guards) -> bool:
        """The drive stops at the deadline of its commands, by its row and, where it can show it, by itself.

        What shows it is a guard, too: a stop that is reckoned with 20 ms shall not become one of 100 ms unnoticed.
        """
        shown = self._quirks.deadline_stops
        if self._quirks.command_deadline is not CommandDeadline.STOPS or shown is None:
            return self._quirks.command_deadline is CommandDeadline.STOPS
        stops = read_optional(guards.sdo, shown.index, shown.subindex) == shown.value
        if stops and self._command_deadline_ms:
            guards.kept.append((shown.index, shown.subindex, shown.value))
        elif self._command_deadline_ms:
            self._notes.append(
                f"0x{shown.index:04X} does not show that the drive stops at the deadline of its commands (0x1400:5): "
                "the heartbeat is what the stop is reckoned with"
            )
        return stops

    def _rated_torque_nm(self, sdo: SdoAccess) -> float:
        raw = sdo.read(Obj402.RATED_TORQUE)
        rated_nm = raw * self._quirks.rated_torque_unit_nm
        wanted = self._amplifier.rated_torque_mnm
        if raw <= 0:
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id}: rated torque 0x6076 reads {raw}; set the motor data"
            )
        if wanted is not None and abs(rated_nm - wanted * 1e-3) > 0.5 * self._quirks.rated_torque_unit_nm:
            found = f"0x6076 = {raw} ({1e3 * rated_nm:g} mN·m)"
            raise BadInput("amplifier.rated_torque_mnm", found, f"{wanted} mN·m as configured")
        return rated_nm

    def _polarity(self, sdo: SdoAccess) -> int:
        """0x607E acts inside the drive on both directions of the wire, so it is reported and never applied again."""
        polarity = read_optional(sdo, Obj402.POLARITY) or 0
        if polarity:
            self._notes.append(f"0x607E polarity is 0x{polarity:02X}: the directions configured here come on top of it")
        return polarity

    def guard_positions(self, sdo: SdoAccess, plan: NodePlan, joint_rad: float) -> list[str]:
        """The drive's own position limits (0x607D), from where the joint stands now; notes for the report."""
        guards = Guards(sdo, plan.facts["guards"], plan.facts["guards_found"])
        write_position_limits(guards, self._config, joint_rad)
        return guards.notes

    def put_back(self, sdo: SdoAccess, plan: NodePlan) -> None:
        """The drive's own limits as they were before `configure`."""
        put_back(sdo, plan.facts["guards_found"])

    def _take_brake(self, sdo: SdoAccess) -> tuple[int, int] | None:
        """Values of 0x60FE:1 that (close, open) the brake and leave every other output as it is found.

        Closed before the output is ours, and read back: nothing may open it by being set up. The mask (0x60FE:2) is
        optional; a drive without one gives all outputs to 0x60FE:1.
        """
        brake = brake_outputs(self._amplifier.brake)
        if brake is None:
            return None
        before = read_optional(sdo, Obj402.DIGITAL_OUTPUTS, 1)
        if before is None:
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id}: object 0x60FE is missing, needed for amplifier.brake"
            )
        bit = brake[0] | brake[1]
        closed, opened = (before & ~bit | value for value in brake)
        write_checked(sdo, Obj402.DIGITAL_OUTPUTS, 1, closed)
        mask = read_optional(sdo, Obj402.DIGITAL_OUTPUTS, 2)
        if mask is not None:
            write_checked(sdo, Obj402.DIGITAL_OUTPUTS, 2, mask | bit)
        return closed, opened

    def _write_interpolation_period(self, sdo: SdoAccess) -> None:
        value, exponent = interpolation_period(self._period_us, self._quirks)
        if write_optional(sdo, Obj402.INTERPOLATION_PERIOD, 1, value):
            write_checked(sdo, Obj402.INTERPOLATION_PERIOD, 2, exponent)
        elif self._quirks.interpolation_period is Presence.REQUIRED:
            raise Unreachable(f"amplifier node {self._amplifier.node_id}: object 0x60C2 is missing")
        else:
            self._notes.append("no 0x60C2: the drive takes its set-points as they come")


# --- What the drive keeps by itself ----------------------------------------------------------------------------------
# What a CiA 402 drive keeps by itself, whatever servod does: its own limits and ways to stop. Off the control path.
#
# Written at bring-up from the limits of the configuration, read back, and read again in turn while the axis runs. A
# limit that stands tighter in the drive is the engineer's: it stays, is told, and counts.


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
    rows = ((Obj402.QUICK_STOP_OPTION, option), (Obj402.FAULT_REACTION_OPTION, option - 4 * quick_stop_stays(option)))
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
    stays = quick_stop_stays(option) and amplifier.brake.by != "output"
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
