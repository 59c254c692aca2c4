"""One node of the axis on the master's side, and its way from unknown to operational. Off the control path.

The steps are kept apart, because their order is the safety of the bring-up: see servod.runtime.fieldbus.master.master.
"""

from __future__ import annotations

from servod.common.errors import FaultCode, Unreachable
from servod.formats.config import AmplifierConfig, AxisConfig, EncoderConfig
from servod.runtime.fieldbus.cia import NmtCommand, NmtState, Obj301
from servod.runtime.fieldbus.devices import NodePlan, Setup
from servod.runtime.fieldbus.master.dcf import left_out, write_parameters
from servod.runtime.fieldbus.master.eds import dictionary_for
from servod.runtime.fieldbus.master.identity import check_identity, read_identity
from servod.runtime.fieldbus.master.monitor import NodeWatch
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.pdo import configure_pdos
from servod.runtime.fieldbus.master.planned import Kind, load_setup
from servod.runtime.fieldbus.master.sdo import NoAnswer, NodeSdo
from servod.runtime.fieldbus.setup_tools import read_optional, write_checked

#: Device profile (0x1000, low word) that a driver kind needs.
PROFILE = {"amplifier": 402, "encoder": 406}
_EMCY_FAULT = {"amplifier": FaultCode.DRIVE_FAULT, "encoder": FaultCode.ENCODER_ALARM}
_BOOT_UP_S = 2.0
_OPERATIONAL_S = 1.0
_MAX_CONSUMERS = 16
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
        self.watch = NodeWatch(network, self.node_id, _EMCY_FAULT[kind], config.heartbeat.node_timeout_ms)

    def report_dictionary(self) -> list[str]:
        """What was mended in the EDS."""
        return [f"{self.dictionary.source}: {line}" for line in self.dictionary.report]

    def identify(self) -> list[str]:
        """Check who it is, by SDO reads alone, which work in operational and pre-operational. Raises Unreachable."""
        try:
            self._ask_for_a_twin()
            found = read_identity(self.sdo)
        except NoAnswer as error:
            raise Unreachable(self._why_silent(str(error))) from None
        check_identity(self.node_id, found, self.section.identity, PROFILE[self._kind])
        return [
            f"node {self.node_id}: profile {found.profile}, vendor 0x{found.vendor_id:08X}, "
            f"product 0x{found.product_code:X}, revision 0x{found.revision:X}, serial {found.serial}"
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
        report += configure_pdos(self.sdo, plan, self.dictionary)
        report += [f"node {self.node_id}: {note}" for note in plan.facts.pop("notes", [])]
        return plan, report + self._report_left_out()

    def _report_left_out(self) -> list[str]:
        if not (indices := left_out(self.dictionary)):
            return []
        names = ", ".join(f"0x{index:04X}" for index in indices)
        return [f"node {self.node_id}: not written from {self.dictionary.source}, they are commands: {names}"]

    def start_heartbeats(self) -> None:
        """0x1017 in the node, and for the amplifier 0x1016: it must stop by itself when we die."""
        heartbeat = self._config.heartbeat
        write_checked(self.sdo, Obj301.HEARTBEAT_PRODUCER, 0, heartbeat.node_period_ms)
        if self._kind == "amplifier":
            self._watch_master(heartbeat.master_node_id << 16 | heartbeat.drive_timeout_ms)

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
        self.watch.nmt_state = None
        send_nmt(self._network, NmtCommand.START, self.node_id)
        if not self._network.wait(lambda: self.watch.nmt_state == NmtState.OPERATIONAL, _OPERATIONAL_S):
            shown = "no heartbeat" if self.watch.nmt_state is None else f"state {self.watch.nmt_state}"
            raise Unreachable(f"node {self.node_id}: not operational after {_OPERATIONAL_S:g} s ({shown})")
        self.watch.watch(True)
