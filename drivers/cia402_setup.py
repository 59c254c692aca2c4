"""CiA 402 amplifier: the set-up face. Off the control path: states the wanted PDOs, writes options, reads scalings.

The order inside `configure` matters: nothing is written to a powered drive; the mode is checked for support before it
is chosen, and chosen before the node becomes operational, because several drives refuse otherwise (drivers/quirks.py).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servod.common.errors import BadInput, Unreachable
from servod.drivers.cia402_state import decode_status_word
from servod.drivers.cia402_target import target_type
from servod.drivers.quirks import Presence, Quirks, load_quirks
from servod.runtime.fieldbus.cia import RPDO_BASE, TPDO_BASE, Obj402
from servod.runtime.fieldbus.devices import Mode, NodePlan, PdoEntry, PdoMap, SdoAccess
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked, write_optional

if TYPE_CHECKING:
    from servod.formats.config import AxisConfig

#: Bit of 0x6502 for each mode that this driver can run.
SUPPORTED_MODE_BIT = {
    Mode.PROFILE_POSITION: 0,
    Mode.CYCLIC_SYNC_POSITION: 7,
    Mode.CYCLIC_SYNC_VELOCITY: 8,
    Mode.CYCLIC_SYNC_TORQUE: 9,
}
_SLOW_TIMER_MS = 100


def amplifier_pdos(node_id: int, mode: Mode, command_deadline_ms: int) -> tuple[PdoMap, ...]:
    """The three PDOs of the amplifier: command, synchronous feedback, and the slow rest by its event timer.

    The heartbeat guards against a dead loop, the command's deadline against commands alone that do not arrive. What a
    drive does at it is its maker's choice, from a fault to the EMCY alone (Novanta Summit, error 0x8250); the EMCY is
    a fault of the axis in any case.
    """
    target = target_type(mode)
    command = (PdoEntry(Obj402.CONTROL_WORD, 0, 16), PdoEntry(target.index, 0, target.bits))
    feedback = (
        PdoEntry(Obj402.STATUS_WORD, 0, 16),
        PdoEntry(Obj402.POSITION_ACTUAL, 0, 32),
        PdoEntry(Obj402.TORQUE_ACTUAL, 0, 16),
    )
    slow = (PdoEntry(Obj402.MODE_DISPLAY, 0, 8), PdoEntry(Obj402.ERROR_CODE, 0, 16))
    return (
        PdoMap(True, 1, RPDO_BASE[0] + node_id, 1, command, event_timer_ms=command_deadline_ms),
        PdoMap(False, 1, TPDO_BASE[0] + node_id, 1, feedback),
        PdoMap(False, 2, TPDO_BASE[1] + node_id, 255, slow, event_timer_ms=_SLOW_TIMER_MS),
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


class AmplifierSetup:
    """Set-up face of a CiA 402 amplifier (servod.runtime.fieldbus.devices.Setup)."""

    def __init__(self, config: AxisConfig, mode: Mode = Mode.CYCLIC_SYNC_TORQUE) -> None:
        self._amplifier = config.amplifier
        self._period_us = config.cycle.period_us
        self._command_deadline_ms = config.heartbeat.drive_timeout_ms
        self._mode = mode
        self._quirks = load_quirks(config.amplifier.quirks)
        self._notes: list[str] = []

    def plan(self) -> NodePlan:
        """The wanted mapping and the facts of the configuration; raises BadInput for what the drive cannot map."""
        amplifier = self._amplifier
        pdos = amplifier_pdos(amplifier.node_id, self._mode, self._command_deadline_ms)
        longest = max(len(pdo.entries) for pdo in pdos)
        if longest > self._quirks.max_pdo_entries:
            raise BadInput("amplifier.quirks", amplifier.quirks, f"a drive that maps {longest} objects in one PDO")
        facts: dict[str, Any] = {
            "mode": int(self._mode),
            "period_s": self._period_us * 1e-6,
            "counts_per_turn": amplifier.counts_per_turn,
            "gear_ratio": amplifier.gear_ratio,
            "position_direction": amplifier.position_direction,
            "torque_direction": amplifier.torque_direction,
            "quick_stop_option": amplifier.quick_stop_option,
            "quirks": amplifier.quirks,
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
        if state.powered:
            raise Unreachable(
                f"amplifier node {self._amplifier.node_id} is powered ({state.name}): "
                "nothing is sent to it; disable it or wait for its heartbeat time-out, then start again"
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
        self._write_options(sdo)
        self._write_interpolation_period(sdo)
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

    def _write_options(self, sdo: SdoAccess) -> None:
        amplifier = self._amplifier
        if not write_optional(sdo, Obj402.QUICK_STOP_OPTION, 0, amplifier.quick_stop_option):
            self._notes.append("no 0x605A: the drive stops by its own quick-stop way")
        if not write_optional(sdo, Obj402.ABORT_CONNECTION, 0, amplifier.heartbeat_reaction):
            self._notes.append("no 0x6007: the drive's own reaction to a lost heartbeat applies")

    def _write_interpolation_period(self, sdo: SdoAccess) -> None:
        value, exponent = interpolation_period(self._period_us, self._quirks)
        if write_optional(sdo, Obj402.INTERPOLATION_PERIOD, 1, value):
            write_checked(sdo, Obj402.INTERPOLATION_PERIOD, 2, exponent)
        elif self._quirks.interpolation_period is Presence.REQUIRED:
            raise Unreachable(f"amplifier node {self._amplifier.node_id}: object 0x60C2 is missing")
        else:
            self._notes.append("no 0x60C2: the drive takes its set-points as they come")
