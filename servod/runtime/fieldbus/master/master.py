"""The CANopen master of one axis: brings amplifier and encoder up, and watches them. Off the control path.

The order of the bring-up is its safety. By reads alone, so that a wrong node id harms nobody: who both nodes are
(0x1018) and whether they may be touched (not powered, no alarms). The bus load is refused before anything is sent. Then
pre-operational; parameters, then mapping, read back and compared; then the drive is made to watch us (0x1016), and
only then NMT start. SYNC, PDOs and the master's heartbeat are the loop's, not ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from servod.common.clock import Clock
from servod.common.errors import BadInput, Unreachable
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import EMCY_BASE, HEARTBEAT_BASE, SDO_ANSWER_BASE, SDO_REQUEST_BASE, NmtCommand
from servod.runtime.fieldbus.devices import GuardedSetup, NodePlan, PresetSetup, SdoAccess
from servod.runtime.fieldbus.master.monitor import GuardWatch, NodeEvent
from servod.runtime.fieldbus.master.network import AnnouncedBus, BusNetwork
from servod.runtime.fieldbus.master.node import Node, NodeIdentity, send_nmt
from servod.runtime.fieldbus.master.planned import checked_load
from servod.runtime.fieldbus.master.start_watch import StartWatch, foreign


@dataclass(frozen=True)
class BringUp:
    """What a successful bring-up gives: the plans for the loop, the share of the bus, and lines for people."""

    amplifier: NodePlan
    encoder: NodePlan
    bus_load: float
    report: list[str] = field(default_factory=list)


def master_ids(config: AxisConfig) -> tuple[int, ...]:
    """What the master listens to; the cyclic frames are the loop's, and the bus keeps them away where it can."""
    bases = (EMCY_BASE, SDO_ANSWER_BASE, SDO_REQUEST_BASE, HEARTBEAT_BASE)
    return tuple(base + node.node_id for node in (config.amplifier, config.encoder) for base in bases)


class Master:
    """Master of one axis on its own bus connection, which it owns from now on.

    `threaded`: with a wall clock, a reader thread of ours takes the frames; without, every wait and `poll` takes them,
    and on the stepped world that is what lets time advance.
    """

    def __init__(
        self, config: AxisConfig, bus: Bus, clock: Clock, threaded: bool, start_bus: Bus | None = None
    ) -> None:
        """`start_bus`: another connection, opened with `start_ids`, that tells of other masters until `hand_over`."""
        self.config = self._config = config
        self._network = BusNetwork(bus, clock, threaded)
        self._start_watch = None if start_bus is None else StartWatch(start_bus, self._network, config)
        try:
            self._amplifier = Node(self._network, config, "amplifier")
            self._encoder = Node(self._network, config, "encoder")
        except BaseException:
            self.close()
            raise
        self._guarded: NodePlan | None = None  # the amplifier's, once it is up
        self._guards: list[GuardWatch] = []
        self._nodes = {node.node_id: node for node in (self._amplifier, self._encoder)}

    def bring_up(self) -> BringUp:
        """Bring both nodes to operational; raises BadInput, Unreachable or SdoAbort with one line that says where."""
        nodes = (self._amplifier, self._encoder)
        for node in nodes:
            node.watch.foreign, node.watch.sets_up = "", False
        report = [line for node in nodes for line in node.report_dictionary()]
        wanted = [node.setup.plan() for node in nodes]
        load = checked_load(self._config, wanted)
        report.append(f"bus load {load.describe()}")
        report += self.look()
        for node in nodes:
            node.watch.sets_up = True
            node.stop_operation()
            node.stop_watching_master()  # whose error, of a master that died, keeps some drives from operational
        plans = []
        for node, plan in zip(nodes, wanted, strict=True):
            report += node.reset_as_quirks_ask(plan)
            configured, lines = node.configure()
            plans.append(configured)
            report += lines
        report += self._guard_positions(plans[0])
        for node, plan in zip(nodes, plans, strict=True):
            node.start_heartbeats(plan)
        for node in nodes:
            node.start()
        self._guarded = plans[0]
        self._guards = [node.guard_watch(plan) for node, plan in zip(nodes, plans, strict=True)]
        try:
            self.look_for_foreign_traffic()
        except Unreachable:
            for node in nodes:  # the guards stay: nobody knows what the other one has done
                self.nmt(NmtCommand.PRE_OPERATIONAL, node.node_id)
            raise
        return BringUp(plans[0], plans[1], load.share, report)

    def look_for_foreign_traffic(self, loop_began_ns: Callable[[], int | None] = lambda: None) -> None:
        """From the bring-up until `hand_over`: raises Unreachable where somebody else spoke with the nodes.

        `loop_began_ns`: since when the loop speaks, None before; see StartWatch.look.
        """
        self._network.drain()
        for node in self._nodes.values():
            if node.watch.foreign:
                raise foreign(node.watch.foreign)
        if self._start_watch is not None:
            self._start_watch.look(loop_began_ns)

    def hand_over(self) -> None:
        """The loop listens, and speaks, from now on."""
        if self._start_watch is not None:
            self._start_watch.close()
            self._start_watch = None
            self._network.announces.clear()

    def look(self) -> list[str]:
        """By reads alone: both nodes are there, are the configured ones, and may be set up; who they are.

        Raises Unreachable with the first thing that is in the way.
        """
        nodes, report = (self._amplifier, self._encoder), []
        for node in nodes:
            node.watch.watch(False)
            report += node.identify()
        for node in nodes:
            node.inspect()
        return report

    def _guard_positions(self, plan: NodePlan) -> list[str]:
        """The drive's own position limits, where it has them and the encoder can be asked where the joint stands."""
        drive, encoder = self._amplifier.setup, self._encoder.setup
        if not isinstance(drive, GuardedSetup) or not isinstance(encoder, PresetSetup):
            return []
        notes = drive.guard_positions(self._amplifier.sdo, plan, encoder.position_rad(self._encoder.sdo))
        return [f"node {plan.node_id}: {note}" for note in notes]

    def preset_encoder(self, position_rad: float) -> tuple[int, float]:
        """Make the joint's present position read `position_rad` in the encoder; what was written, and what it reads.

        Instead of a bring-up, while no loop runs. Raises Unreachable where a node is not the configured one, the
        amplifier is powered or the joint moves, BadInput when the encoder's driver knows no preset.
        """
        setup = self._encoder.setup
        if not isinstance(setup, PresetSetup):
            raise BadInput("encoder.driver", self._config.encoder.driver, "a driver with preset")
        self.look()
        counts = setup.preset(self._encoder.sdo, position_rad)
        return counts, setup.position_rad(self._encoder.sdo)

    def stand_down(self) -> None:
        """Orderly end: nodes pre-operational and the drive no longer watching us. Only when the drive has no torque."""
        for node in self._nodes.values():
            node.watch.watch(False)
            send_nmt(self._network, NmtCommand.PRE_OPERATIONAL, node.node_id)
            node.stop_watching_master()
        drive = self._amplifier.setup
        if self._guarded and isinstance(drive, GuardedSetup):
            drive.put_back(self._amplifier.sdo, self._guarded)

    def poll(self) -> None:
        """Take waiting frames and check the heartbeats; call at least every 20 ms.

        Raises Unreachable when the reader thread ended.
        """
        if self._network.broken is not None:
            raise Unreachable(f"bus reader ended: {self._network.broken}")
        self._network.drain()
        for node in self._nodes.values():
            node.watch.check()
        for guards in self._guards:
            guards.check()

    def events(self) -> list[NodeEvent]:
        """What the nodes did since the last call, oldest first."""
        found: list[NodeEvent] = []
        for node in self._nodes.values():
            while node.watch.events:
                found.append(node.watch.events.popleft())
        return sorted(found, key=lambda event: event.time_ns)

    def identity(self, node_id: int) -> NodeIdentity | None:
        """What a node said of itself (0x1018) when it was brought up; None before."""
        return self._nodes[node_id].identity

    def sdo(self, node_id: int) -> SdoAccess:
        """SDO access to one of the two nodes."""
        if node_id not in self._nodes:
            raise BadInput("node id", node_id, " or ".join(str(known) for known in self._nodes))
        return self._nodes[node_id].sdo

    def nmt_state(self, node_id: int) -> int | None:
        """State that the node's last heartbeat showed (servod.runtime.fieldbus.cia.NmtState); None before the first."""
        return self._nodes[node_id].watch.nmt_state

    def silent(self, node_id: int) -> bool:
        """The node's heartbeat has been missing for its time, and has not come back."""
        return self._nodes[node_id].watch.lost

    def heartbeat_age_s(self, node_id: int) -> float | None:
        """How long ago the node's last heartbeat came, in s; None before the first."""
        return self._nodes[node_id].watch.heartbeat_age_s()

    def heartbeat_limit_s(self, node_id: int) -> float:
        """A heartbeat older than this, in s, is missing."""
        return self._nodes[node_id].watch.limit_s

    def nmt(self, command: NmtCommand, node_id: int) -> None:
        """Send an NMT command; node 0 is all nodes. A deliberate reset or stop is not reported as an event."""
        for node in self._nodes.values():
            if node_id in (0, node.node_id):
                node.watch.watch(command == NmtCommand.START)
        send_nmt(self._network, command, node_id)

    @property
    def clock(self) -> Clock:
        """What the waits here go by."""
        return self._network.clock

    def pause(self, duration_s: float) -> None:
        """Wait, and take frames meanwhile."""
        self._network.wait(lambda: False, duration_s)

    def of_ours(self, bus: Bus) -> Bus:
        """`bus`, a further connection of this process, so that the watch knows its frames from those of others."""
        return AnnouncedBus(bus, self._network)

    def close(self) -> None:
        """Leave the bus; nothing is sent."""
        self.hand_over()
        self._network.disconnect()
