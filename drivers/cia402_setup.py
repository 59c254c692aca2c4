"""CiA 402 amplifier: the set-up face. Off the control path: states the wanted PDOs, writes options, reads scalings.

The order inside `configure` matters: nothing is written to a powered drive; the mode is checked for support before it
is chosen, and chosen before the node becomes operational, because several drives refuse otherwise (drivers/quirks.py).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servod.common.errors import BadInput, Unreachable
from servod.drivers.cia402_guards import Guards, put_back, write_limits, write_position_limits, write_ramp, write_stops
from servod.drivers.cia402_target import target_type
from servod.drivers.quirks import CommandDeadline, Presence, Quirks, load_quirks
from servod.runtime.fieldbus.cia import RPDO_BASE, TPDO_BASE, Obj301, Obj402, decode_status_word
from servod.runtime.fieldbus.devices import DriveInput, DriveState, Mode, NodePlan, PdoEntry, PdoMap, SdoAccess
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
_SLOW_TIMER_MS = 100
#: Drives need not send the PDO when an input changes: so often they send it anyway, if somebody acts on its inputs.
_INPUTS_TIMER_MS = 10
#: Bits of 0x1001: current, voltage, temperature (CiA 301).
_POWER_ERRORS = 0x0E


def amplifier_pdos(
    node_id: int, mode: Mode, command_deadline_ms: int, with_inputs: bool = False, with_outputs: bool = False
) -> tuple[PdoMap, ...]:
    """The three PDOs of the amplifier: command, synchronous feedback, and the slow rest by its event timer.

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
    slow_ms = _INPUTS_TIMER_MS if with_inputs else _SLOW_TIMER_MS
    return (
        PdoMap(True, 1, RPDO_BASE[0] + node_id, 1, command, event_timer_ms=command_deadline_ms),
        PdoMap(False, 1, TPDO_BASE[0] + node_id, 1, feedback),
        PdoMap(False, 2, TPDO_BASE[1] + node_id, 255, slow, event_timer_ms=slow_ms),
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
        pdos = amplifier_pdos(amplifier.node_id, self._mode, self._command_deadline_ms, bool(inputs), brake is not None)
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
        if state is DriveState.QUICK_STOP_ACTIVE and self._amplifier.quick_stop_option > 4:
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
