"""One node of the axis on the master's side, and its way from unknown to operational. Off the control path.

The steps are kept apart, because their order is the safety of the bring-up: see servod.runtime.fieldbus.master.master.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from canopen.objectdictionary import ODVariable, datatypes

from servod.common.errors import BadInput, Unreachable
from servod.common.faults import FaultCode
from servod.formats.config import AmplifierConfig, AxisConfig, EncoderConfig, Identity
from servod.runtime.fieldbus.cia import PDO_NO_RTR, PDO_NOT_VALID, NmtCommand, NmtState, Obj301, acts_when_written
from servod.runtime.fieldbus.devices import EVENT_DRIVEN, NodePlan, PdoMap, SdoAbort, SdoAccess, Setup
from servod.runtime.fieldbus.master.eds import Dictionary, dictionary_for
from servod.runtime.fieldbus.master.monitor import GuardWatch, NodeWatch
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.planned import Kind, load_setup
from servod.runtime.fieldbus.master.sdo import NodeSdo, SdoNoAnswer
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked

# --- PDO mappings ----------------------------------------------------------------------------------------------------
# Writes PDO mappings by the sequence of CiA 301, reads everything back and compares. A wrong mapping is the worst kind
# of error: the drive accepts it and every value after it is plausible garbage. So the lengths are checked against the
# EDS before, and the device's own answer against the plan after.


_COB_ID, _TYPE, _INHIBIT, _EVENT_TIMER = 1, 2, 3, 5  # sub-indices of 1400/1800
_COMPARED_COB_BITS = ~PDO_NO_RTR & 0xFFFFFFFF  # bit 30 is the device's own business
_FIRST_DATA_OBJECT = 0x20  # indices below are the dummy types that fill gaps


def parameter_index(pdo: PdoMap) -> int:
    """Index of the communication parameter (0x1400 or 0x1800 and up)."""
    return (Obj301.RPDO_PARAMETER if pdo.receive else Obj301.TPDO_PARAMETER) + pdo.number - 1


def mapping_index(pdo: PdoMap) -> int:
    """Index of the mapping (0x1600 or 0x1A00 and up)."""
    return (Obj301.RPDO_MAPPING if pdo.receive else Obj301.TPDO_MAPPING) + pdo.number - 1


def check_lengths(plan: NodePlan, dictionary: Dictionary) -> None:
    """Raise BadInput when a mapped object is not in the EDS, or has another length there."""
    for pdo in plan.pdos:
        for entry in pdo.entries:
            if entry.index < _FIRST_DATA_OBJECT:
                continue
            name = f"0x{entry.index:04X}:{entry.subindex}"
            variable = dictionary.objects.get_variable(entry.index, entry.subindex)
            if variable is None:
                raise BadInput(dictionary.source, f"no object {name}", f"the object: driver {plan.driver} maps it")
            if len(variable) != entry.bits:
                raise BadInput(dictionary.source, f"object {name} with {len(variable)} bits", f"{entry.bits} bits")


def write_pdo(sdo: SdoAccess, pdo: PdoMap) -> tuple[PdoMap, bool]:
    """Write one PDO: not valid, mapping off, entries, mapping on, parameters, valid.

    The PDO as the device has it now, and whether it has a deadline where it wants one.
    """
    parameter, mapping = parameter_index(pdo), mapping_index(pdo)
    present = sdo.read(parameter, _COB_ID)
    sdo.write(parameter, _COB_ID, present | PDO_NOT_VALID)
    sdo.write(mapping, 0, 0)
    for number, entry in enumerate(pdo.entries, start=1):
        sdo.write(mapping, number, entry.word)
    sdo.write(mapping, 0, len(pdo.entries))
    pdo = with_type(sdo, pdo)
    for subindex, wanted, found in timers(sdo, pdo):
        if found != wanted:
            sdo.write(parameter, subindex, wanted)
    guarded = not pdo.receive or write_deadline(sdo, pdo)
    sdo.write(parameter, _COB_ID, pdo.cob_id | present & PDO_NO_RTR)
    return pdo, guarded


def with_type(sdo: SdoAccess, pdo: PdoMap) -> PdoMap:
    """Write the transmission type; a device without that every n-th SYNC follows events instead, by its event timer.

    CiA 301 lets a device refuse types that it does not have; every drive has 1 and 254 or 255.
    """
    try:
        sdo.write(parameter_index(pdo), _TYPE, pdo.transmission_type)
        kept = sdo.read(parameter_index(pdo), _TYPE) if pdo.syncs > 1 else pdo.transmission_type
    except SdoAbort:
        if pdo.syncs <= 1:
            raise
        kept = EVENT_DRIVEN
    if kept != pdo.transmission_type:
        pdo = replace(pdo, transmission_type=EVENT_DRIVEN)
        sdo.write(parameter_index(pdo), _TYPE, pdo.transmission_type)
    return pdo


def timers(sdo: SdoAccess, pdo: PdoMap) -> list[tuple[int, int, int]]:
    """Rows of (sub-index, wanted, present) of a TPDO's timers, as far as the device has them; none of an RPDO's.

    A default inhibit time is cleared: it would swallow changes that come too close together. Raises Unreachable when
    a timer is wanted and missing.
    """
    rows = []
    for subindex, wanted in () if pdo.receive else ((_INHIBIT, pdo.inhibit_100us), (_EVENT_TIMER, pdo.timer_ms)):
        present = read_optional(sdo, parameter_index(pdo), subindex)
        if present is not None:
            rows.append((subindex, wanted, present))
        elif wanted:
            raise Unreachable(f"object 0x{parameter_index(pdo):04X}:{subindex} is missing, needed for {wanted}")
    return rows


def write_deadline(sdo: SdoAccess, pdo: PdoMap) -> bool:
    """Write and read back the deadline of an RPDO; False when the device or its EDS has none, or it is not writable.

    CiA 301: EMCY 8250 when the next RPDO does not come in time. A guard beside the heartbeat, so a device may lack it.
    """
    index = parameter_index(pdo)
    try:
        if sdo.read(index, _EVENT_TIMER) != pdo.event_timer_ms:
            write_checked(sdo, index, _EVENT_TIMER, pdo.event_timer_ms)
    except SdoAbort:
        return False
    return True


def expected(sdo: SdoAccess, pdo: PdoMap) -> list[tuple[int, int, int, int]]:
    """What must be read back, all that was written: rows of (index, subindex, mask, value)."""
    parameter, mapping = parameter_index(pdo), mapping_index(pdo)
    rows = [
        (parameter, _COB_ID, _COMPARED_COB_BITS, pdo.cob_id),
        (parameter, _TYPE, 0xFF, pdo.transmission_type),
        (mapping, 0, 0xFF, len(pdo.entries)),
    ]
    rows += [(mapping, number, 0xFFFFFFFF, entry.word) for number, entry in enumerate(pdo.entries, start=1)]
    return rows + [(parameter, subindex, 0xFFFF, wanted) for subindex, wanted, _ in timers(sdo, pdo)]


def verify_pdo(sdo: SdoAccess, node_id: int, pdo: PdoMap) -> None:
    """Read one PDO back and compare; raises Unreachable naming object, wrote and read."""
    for index, subindex, mask, value in expected(sdo, pdo):
        read = sdo.read(index, subindex)
        if read & mask != value:
            name = f"node {node_id} {'R' if pdo.receive else 'T'}PDO{pdo.number}, object 0x{index:04X}:{subindex}"
            raise Unreachable(f"{name}: wrote 0x{value:08X}, device reads 0x{read:08X}")


def disable_other_pdos(sdo: SdoAccess, plan: NodePlan) -> list[int]:
    """Set every PDO that is not planned to not valid; the parameter indices that were valid before.

    `plan.facts["pdo_pairs"]` says how many the device may have; one that does not exist ends the count.
    """
    planned = {parameter_index(pdo) for pdo in plan.pdos}
    switched_off = []
    for first in (Obj301.RPDO_PARAMETER, Obj301.TPDO_PARAMETER):
        for index in range(first, first + int(plan.facts.get("pdo_pairs", 4))):
            if index in planned:
                continue
            cob_id = read_optional(sdo, index, _COB_ID)
            if cob_id is not None and not cob_id & PDO_NOT_VALID:
                sdo.write(index, _COB_ID, cob_id | PDO_NOT_VALID)
                switched_off.append(index)
    return switched_off


def configure_pdos(sdo: SdoAccess, plan: NodePlan, dictionary: Dictionary) -> tuple[NodePlan, list[str]]:
    """Check, write and verify all PDOs of a plan; the plan as the device has it, and lines for the report."""
    check_lengths(plan, dictionary)
    switched_off = disable_other_pdos(sdo, plan)
    written = [write_pdo(sdo, pdo) for pdo in plan.pdos]
    deadlines = [pdo.event_timer_ms for pdo, guarded in written if pdo.receive and guarded]
    events = [f"TPDO{pdo.number}" for (pdo, _), wanted in zip(written, plan.pdos, strict=True) if pdo != wanted]
    plan = replace(plan, pdos=tuple(pdo for pdo, _ in written))
    plan.facts["deadline_told_ms"] = deadline_ms = min(deadlines, default=0)
    plan.facts["command_deadline_ms"] = deadline_ms if plan.facts.get("deadline_stops") else 0
    for pdo in plan.pdos:
        verify_pdo(sdo, plan.node_id, pdo)
    report = [f"node {plan.node_id}: {len(plan.pdos)} PDOs written and read back"]
    if switched_off:
        report.append(f"node {plan.node_id}: switched off {', '.join(f'0x{i:04X}' for i in switched_off)}")
    if events:
        report.append(f"node {plan.node_id}: {', '.join(events)} by events: it sends none with every n-th SYNC")
    return plan, report


# --- DCF values ------------------------------------------------------------------------------------------------------
# Writes the parameter values of a DCF to a node. A DCF is an EDS with ParameterValue keys: how somebody configured this
# device with the maker's tool. Only the device's own parameters (0x2000 and up) are taken from it: communication
# objects are the bring-up's, which verifies them, and what acts when it is written (control word, set-points, outputs,
# presets) is nobody's to write from a file.


_FIRST_DEVICE_OBJECT = 0x2000
_WRITABLE = ("rw", "rww", "rwr")  # CiA 306; write-only objects are commands, not parameters


def parameters(dictionary: Dictionary) -> Iterator[tuple[int, int, int]]:
    """(index, subindex, value) of the device's parameters that the file gives a value, by rising index."""
    return (row for row in _values(dictionary) if not acts_when_written(row[0]))


def left_out(dictionary: Dictionary) -> list[int]:
    """Indices of the objects that the file gives a value, but that act when they are written."""
    return sorted({index for index, _, _ in _values(dictionary) if acts_when_written(index)})


def _values(dictionary: Dictionary) -> Iterator[tuple[int, int, int]]:
    """All writable integers of the device that the file gives a value."""
    for index in sorted(dictionary.objects):
        entry = dictionary.objects[index]
        for variable in (entry,) if isinstance(entry, ODVariable) else entry.values():
            writable = variable.access_type in _WRITABLE and variable.data_type in datatypes.INTEGER_TYPES
            if index >= _FIRST_DEVICE_OBJECT and writable and variable.value is not None:
                yield index, variable.subindex, variable.value


def write_parameters(sdo: SdoAccess, dictionary: Dictionary) -> int:
    """Write each value that the node does not have yet and read it back; how many were written. Raises as SDO does."""
    written = 0
    for index, subindex, value in parameters(dictionary):
        if sdo.read(index, subindex) != value:
            write_checked(sdo, index, subindex, value)
            written += 1
    return written


# --- Identity --------------------------------------------------------------------------------------------------------
# The identity of a node (0x1018), checked before anything is written to it.


#: Sub-index of 0x1018 for each number that the configuration may state.
_SUBINDEX = {"vendor_id": 1, "product_code": 2, "revision": 3, "serial": 4}
_PROFILE_MASK = 0xFFFF


@dataclass(frozen=True, slots=True)
class NodeIdentity:
    """What a node says of itself; numbers that it does not have are None."""

    device_type: int
    vendor_id: int
    product_code: int | None
    revision: int | None
    serial: int | None

    @property
    def profile(self) -> int:
        """Number of the device profile: 402 for drives, 406 for encoders (low word of 0x1000)."""
        return self.device_type & _PROFILE_MASK


def read_identity(sdo: NodeSdo) -> NodeIdentity:
    """Read 0x1000 and 0x1018; only sub-index 1 is mandatory."""

    def optional(subindex: int) -> int | None:
        try:
            return sdo.read(Obj301.IDENTITY, subindex)
        except SdoAbort:
            return None

    return NodeIdentity(
        sdo.read(Obj301.DEVICE_TYPE), sdo.read(Obj301.IDENTITY, 1), optional(2), optional(3), optional(4)
    )


def check_identity(node_id: int, found: NodeIdentity, wanted: Identity, profile: int | None) -> None:
    """Raise Unreachable when the node is not the configured device, naming each number that differs."""
    wrong = [
        f"{name} (0x1018:{subindex}) is {_hex(getattr(found, name))}, configured is {_hex(getattr(wanted, name))}"
        for name, subindex in _SUBINDEX.items()
        if getattr(wanted, name) is not None and getattr(wanted, name) != getattr(found, name)
    ]
    if profile is not None and found.profile != profile:
        wrong.append(f"device profile (0x1000) is {found.profile}, the driver needs {profile}")
    if wrong:
        raise Unreachable(f"node {node_id} is another device: {'; '.join(wrong)}; nothing was written to it")


def _hex(value: int | None) -> str:
    return "absent" if value is None else f"0x{value:08X}"


#: Device profile (0x1000, low word) that a driver kind needs.
PROFILE = {"amplifier": 402, "encoder": 406}
_EMCY_FAULT = {"amplifier": FaultCode.DRIVE_FAULT, "encoder": FaultCode.ENCODER_ALARM}
_BOOT_UP_S = 2.0
_OPERATIONAL_S = 1.0
_MAX_CONSUMERS = 16
_MOST_ERRORS = 8  # of the history, for the log
#: A second node with the same id answers the same request within this time.
_TWIN_S = 0.005


def send_nmt(network: BusNetwork, command: NmtCommand, node_id: int) -> None:
    """Send one NMT command; node 0 is all nodes."""
    network.send_message(0, bytes((command, node_id)))


class Node:
    """One configured device: driver, dictionary, SDO access and supervision."""

    def __init__(self, network: BusNetwork, config: AxisConfig, kind: Kind) -> None:
        self.section: AmplifierConfig | EncoderConfig = config.amplifier if kind == "amplifier" else config.encoder
        self.node_id = self.section.node_id
        self._network, self._config, self._kind = network, config, kind
        self.setup: Setup = load_setup(config, kind)
        self.dictionary = dictionary_for(self.section.driver, self.section.eds, self.node_id)
        self.sdo = NodeSdo(network, self.node_id, self.dictionary.objects)
        heartbeat = config.heartbeat
        self.watch = NodeWatch(
            network, self.node_id, _EMCY_FAULT[kind], heartbeat.node_period_ms, heartbeat.node_timeout_ms
        )
        self.identity: NodeIdentity | None = None
        self.error_register = 0  # as read last (0x1001)

    def report_dictionary(self) -> list[str]:
        """What was mended in the EDS."""
        return [f"{self.dictionary.source}: {line}" for line in self.dictionary.report]

    def identify(self) -> list[str]:
        """Check who it is, by SDO reads alone, which work in operational and pre-operational. Raises Unreachable."""
        try:
            self._ask_for_a_twin()
            found = read_identity(self.sdo)
        except SdoNoAnswer as error:
            raise Unreachable(self._why_silent(str(error))) from None
        check_identity(self.node_id, found, self.section.identity, PROFILE[self._kind])
        self.identity = found
        numbers = {"product": found.product_code, "revision": found.revision}
        words = (f"{name} {'absent' if value is None else f'0x{value:X}'}" for name, value in numbers.items())
        serial = "absent" if found.serial is None else found.serial
        return [
            f"node {self.node_id}: profile {found.profile}, vendor 0x{found.vendor_id:08X}, {', '.join(words)}, "
            f"serial {serial}",
            *self._errors(),
        ]

    def _errors(self) -> list[str]:
        """What stands in its error register and history (0x1001, 0x1003), newest first, for the log."""
        self.error_register = read_optional(self.sdo, Obj301.ERROR_REGISTER) or 0
        count = min(read_optional(self.sdo, Obj301.ERROR_HISTORY) or 0, _MOST_ERRORS)
        history = [read_optional(self.sdo, Obj301.ERROR_HISTORY, number) or 0 for number in range(1, count + 1)]
        codes = ", ".join(f"0x{error & 0xFFFF:04X}" for error in history) or "none"
        if not self.error_register and not history:
            return []
        return [
            f"node {self.node_id}: error register 0x{self.error_register:02X}, errors so far, newest first: {codes}"
        ]

    def _ask_for_a_twin(self) -> None:
        """One read that tells two nodes from one; raises Unreachable when both answer."""
        self.sdo.read(Obj301.DEVICE_TYPE)
        if self.sdo.answered_again(_TWIN_S):
            raise Unreachable(
                f"two nodes answer as node {self.node_id}; give each its own id (`servoctl scan` shows who is there)"
            )

    def _why_silent(self, error: str) -> str:
        if self.watch.nmt_state == NmtState.STOPPED:
            return (
                f"node {self.node_id} is NMT stopped and answers no SDO, so who it is cannot be asked; "
                "switch it off and on, or send it NMT pre-operational"
            )
        return f"{error}; is node {self.node_id} there, supplied, not NMT stopped, and at this bit rate?"

    def inspect(self) -> None:
        """Look whether it may be set up now; raises Unreachable when it is powered or shows alarms."""
        self.setup.inspect(self.sdo)

    def stop_operation(self) -> None:
        """Bring to pre-operational: from here on no PDO acts. A drive that is switched on leaves that by 0x6007."""
        send_nmt(self._network, NmtCommand.PRE_OPERATIONAL, self.node_id)

    def reset_as_quirks_ask(self, plan: NodePlan) -> list[str]:
        """Reset the node's communication where its quirks want that: always, or after certain last errors."""
        if plan.facts.get("reset_communication_at_start"):
            self.reset_communication()
            return [f"node {self.node_id}: communication reset, as its quirks ask"]
        sticky = plan.facts.get("reset_communication_after", ())
        newest = read_optional(self.sdo, Obj301.ERROR_HISTORY, 1) if sticky else None
        if newest is None or newest & 0xFFFF not in sticky:
            return []
        self.reset_communication()
        return [f"node {self.node_id}: communication reset after error 0x{newest & 0xFFFF:04X}"]

    def reset_communication(self) -> None:
        """NMT reset communication, and wait for the boot-up. Raises Unreachable when it does not come."""
        before = self.watch.boot_ups
        send_nmt(self._network, NmtCommand.RESET_COMMUNICATION, self.node_id)
        if not self._network.wait(lambda: self.watch.boot_ups > before, _BOOT_UP_S):
            raise Unreachable(f"node {self.node_id}: no boot-up {_BOOT_UP_S:g} s after reset communication")

    def configure(self) -> tuple[NodePlan, list[str]]:
        """Parameters, then mapping written, read back and compared; the plan with its facts, and the report.

        After values of a DCF the set-up face goes again: its scalings and options have the last word, and it refuses a
        device that the values have powered.
        """
        plan, report = self.setup.configure(self.sdo), []
        if written := write_parameters(self.sdo, self.dictionary):
            plan = self.setup.configure(self.sdo)
            report.append(f"node {self.node_id}: {written} parameters written from {self.dictionary.source}")
        plan, lines = configure_pdos(self.sdo, plan, self.dictionary)
        report += lines
        if self._kind == "amplifier":
            report.append(f"node {self.node_id}: {self._guard_against_silence(plan)}")
        report += [f"node {self.node_id}: {note}" for note in plan.facts.pop("notes", [])]
        return plan, report + self._report_left_out()

    def _guard_against_silence(self, plan: NodePlan) -> str:
        """Facts of how soon the drive stops when the master is dead: by the command deadline, else by the heartbeat.

        Two periods of the heartbeat must do, which may guard alone: SYNC lost, or a deadline that only tells. Raises
        Unreachable where neither guards, unless the configuration takes that on itself.
        """
        facts, heartbeat, deadline_ms = plan.facts, self._config.heartbeat, plan.facts["command_deadline_ms"]
        for pdo in plan.pdos:
            if pdo.receive and facts["deadline_told_ms"]:
                facts["guards"].append((parameter_index(pdo), _EVENT_TIMER, facts["deadline_told_ms"]))
        facts["unguarded"] = not (deadline_ms or facts.get("heartbeat_reaction", True))
        if facts["unguarded"] and not self._config.amplifier.unguarded:
            raise Unreachable(
                f"amplifier node {self.node_id} does not stop by itself when servod is dead: it has neither 0x6007 nor "
                "a deadline of its commands (0x1400:5) that stops it; use another drive, or, where nobody can be hurt, "
                "amplifier.unguarded: true"
            )
        facts["heartbeat_timeout_ms"] = min(heartbeat.drive_timeout_ms, 2 * heartbeat.master_period_ms)
        facts["reaction_ms"] = deadline_ms or facts["heartbeat_timeout_ms"]
        if deadline_ms:
            return f"stops {deadline_ms} ms after the last command (0x1400:5)"
        return f"no command deadline counts, the heartbeat guards alone: {facts['reaction_ms']} ms (0x1016)"

    def _report_left_out(self) -> list[str]:
        if not (indices := left_out(self.dictionary)):
            return []
        names = ", ".join(f"0x{index:04X}" for index in indices)
        return [f"node {self.node_id}: not written from {self.dictionary.source}, they are commands: {names}"]

    def start_heartbeats(self, plan: NodePlan) -> None:
        """0x1017 in the node, and for the amplifier 0x1016: it must stop by itself when we die."""
        heartbeat = self._config.heartbeat
        write_checked(self.sdo, Obj301.HEARTBEAT_PRODUCER, 0, heartbeat.node_period_ms)
        if self._kind == "amplifier":
            entry = heartbeat.master_node_id << 16 | int(plan.facts["heartbeat_timeout_ms"])
            self._watch_master(entry)
            plan.facts["guards"].append((int(Obj301.HEARTBEAT_CONSUMER), 1, entry))

    def guard_watch(self, plan: NodePlan) -> GuardWatch:
        """What reads the drive's guards again in turn."""
        return GuardWatch(self.sdo, self.watch, plan.facts.get("guards", ()), self._network.clock)

    def stop_watching_master(self) -> None:
        """Let the node forget the master's heartbeat, for an orderly end; only while it has no torque."""
        if self._kind == "amplifier":
            self._watch_master(0)

    def _watch_master(self, entry: int) -> None:
        """Write 0x1016:1; an older entry for the same node elsewhere would be a duplicate (abort 06040043)."""
        master_id = self._config.heartbeat.master_node_id
        count = min(self.sdo.read(Obj301.HEARTBEAT_CONSUMER, 0), _MAX_CONSUMERS)
        for subindex in range(2, count + 1):
            if self.sdo.read(Obj301.HEARTBEAT_CONSUMER, subindex) >> 16 & 0x7F == master_id:
                self.sdo.write(Obj301.HEARTBEAT_CONSUMER, subindex, 0)
        write_checked(self.sdo, Obj301.HEARTBEAT_CONSUMER, 1, entry)

    def start(self) -> None:
        """NMT start, seen in the node's own heartbeat. Raises Unreachable when it stays elsewhere."""
        if read_optional(self.sdo, Obj301.ERROR_REGISTER):
            self.watch.has_errors()
        self.watch.nmt_state = None
        send_nmt(self._network, NmtCommand.START, self.node_id)
        if not self._network.wait(lambda: self.watch.nmt_state == NmtState.OPERATIONAL, _OPERATIONAL_S):
            shown = "no heartbeat" if self.watch.nmt_state is None else f"state {self.watch.nmt_state}"
            raise Unreachable(f"node {self.node_id}: not operational after {_OPERATIONAL_S:g} s ({shown})")
        self.watch.watch(True)
