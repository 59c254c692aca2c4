"""A CANopen node: NMT slave with all communication services of CiA 301 around one object dictionary.

Between the bus and the device (amplifier, encoder), which derives from it. Frames come in by `receive`, leave by the
`send` given at the start; time comes with every frame and deadline.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from servod.drivers.virtual.dictionary import DeviceDictionary, SdoRefusal, Storage
from servod.drivers.virtual.error_control import Emergency, HeartbeatConsumer, HeartbeatProducer
from servod.drivers.virtual.lss import LssSlave
from servod.drivers.virtual.pdo import PdoEngine
from servod.drivers.virtual.port import ErrorState
from servod.drivers.virtual.sdo_server import SdoServer
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.bus import CAN_RTR_FLAG
from servod.runtime.fieldbus.cia import (
    HEARTBEAT_BASE,
    LSS_FROM_SLAVE_ID,
    LSS_TO_SLAVE_ID,
    NMT_ID,
    SDO_ANSWER_BASE,
    SDO_REQUEST_BASE,
    Abort,
    Emcy,
    NmtCommand,
    NmtState,
    Obj301,
)

Send = Callable[[int, bytes, int], object]
_ERROR_PASSIVE = 0x8120
_COMMUNICATION = (0x1000, 0x1FFF)
_APPLICATION = (0x2000, 0x9FFF)


class VirtualNode(ABC):
    """One node. Derived devices fill in `refresh`, `commanded`, `reset_application`, `connection_lost`."""

    def __init__(self, eds: Path, node_id: int, serial: int, timeline: Timeline, send: Send) -> None:
        self.dictionary = DeviceDictionary(eds)
        self.dictionary.entry(Obj301.IDENTITY, 4).default = serial
        self.timeline = timeline
        self.state = NmtState.BOOT_UP
        self.nmt_taken: Counter[int] = Counter()  # NMT commands that reached it
        self._put = send
        self.dictionary.reset(*_COMMUNICATION, node_id)
        self.dictionary.reset(*_APPLICATION, node_id)
        self.dictionary.entry(0x1021).raw = eds.read_bytes()
        self.storage = Storage(self.dictionary)
        self.emergency = Emergency(self.dictionary, self._send_emergency, timeline)
        self.pdo = PdoEngine(self.dictionary, timeline, self.emergency, send, self)
        self.sdo = SdoServer(self.dictionary, self._send_sdo, timeline)
        self.producer = HeartbeatProducer(self.dictionary, self._send_heartbeat, timeline)
        self.consumer = HeartbeatConsumer(self.dictionary, timeline, self._heartbeat_lost, self._heartbeat_found)
        identity = self.dictionary.value
        numbers = (identity(0x1018, 1), identity(0x1018, 2), identity(0x1018, 3), identity(0x1018, 4))
        self.lss = LssSlave(numbers, node_id, self._send_lss)
        self._routes: dict[int, Callable[[int, bytes, int], None]] = {}
        self._guard_toggle = 0
        self._hook_entries()

    # --- what a device fills in --------------------------------------------------------------------------------

    @abstractmethod
    def refresh(self, time_ns: int) -> None:
        """Bring the actual values of the dictionary up to `time_ns`."""

    @abstractmethod
    def commanded(self, time_ns: int) -> None:
        """An RPDO was applied."""

    @abstractmethod
    def reset_application(self, time_ns: int) -> None:
        """The device starts again (power on, NMT reset node); its objects have their defaults."""

    @abstractmethod
    def connection_lost(self, time_ns: int, code: int = Emcy.HEARTBEAT_LOST) -> None:
        """The master is silent, its commands are overdue, the bus is off, or NMT left operational; `code` says what."""

    def commands_overdue(self, time_ns: int) -> None:  # noqa: B027
        """CiA 301 asks for the EMCY alone; a device that does more fills this in."""

    # --- life --------------------------------------------------------------------------------------------------

    @property
    def node_id(self) -> int:
        """Present node id (0xFF: not configured, only LSS answers)."""
        return self.lss.node_id

    def power_on(self, time_ns: int) -> None:
        """Start: initialise, say boot-up, go pre-operational."""
        self.timeline.now_ns = time_ns
        self._reset_node(time_ns)

    def receive(self, can_id: int, data: bytes, time_ns: int) -> None:
        """One frame from the bus, with the moment at which it ended."""
        route = self._routes.get(can_id)
        if route is not None:
            self.timeline.now_ns = time_ns
            route(can_id, data, time_ns)

    def bus_state(self, state: ErrorState, time_ns: int) -> None:
        """The node's CAN controller changed its error state."""
        if state is ErrorState.BUS_OFF:
            self.connection_lost(time_ns)
            self._error_behaviour(time_ns)
            self._was_bus_off = True
        elif state is ErrorState.PASSIVE:
            self.emergency.set(_ERROR_PASSIVE, time_ns)
        else:
            self.emergency.clear(_ERROR_PASSIVE, time_ns)
            if self._was_bus_off:
                self._was_bus_off = False
                self.emergency.set(Emcy.BUS_OFF_RECOVERED, time_ns)
                self.emergency.clear(Emcy.BUS_OFF_RECOVERED, time_ns)

    _was_bus_off = False

    def _reset_node(self, time_ns: int) -> None:
        self.storage.restore(*_APPLICATION, self.lss.pending_node_id)
        self.emergency.reset()
        self.reset_application(time_ns)
        self._reset_communication(time_ns)

    def _reset_communication(self, time_ns: int) -> None:
        """Initialise the communication objects with the (possibly new) node id and boot."""
        if self.state is NmtState.OPERATIONAL:
            self.connection_lost(time_ns)
        self.pdo.stop()
        self.sdo.reset()
        self.lss.node_id = self.lss.pending_node_id
        self.state = NmtState.BOOT_UP
        self.storage.restore(*_COMMUNICATION, self.node_id)
        self.pdo.configure()
        self.consumer.configure()
        self._route()
        if self.node_id <= 127:
            self._send_heartbeat(time_ns)
            self.producer.restart(time_ns)
            self.state = NmtState.PRE_OPERATIONAL
        else:
            self.producer.stop()

    def _nmt(self, can_id: int, data: bytes, time_ns: int) -> None:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        command = data[0]
        self.nmt_taken[command] += 1
        if command == NmtCommand.START:
            self._enter(NmtState.OPERATIONAL, time_ns)
        elif command == NmtCommand.STOP:
            self._enter(NmtState.STOPPED, time_ns)
        elif command == NmtCommand.PRE_OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, time_ns)
        elif command == NmtCommand.RESET_NODE:
            self._reset_node(time_ns)
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._reset_communication(time_ns)

    def _enter(self, state: NmtState, time_ns: int) -> None:
        old, self.state = self.state, state
        if old is state:
            return
        if old is NmtState.OPERATIONAL:
            self.pdo.stop()
            self.connection_lost(time_ns)
        if state is NmtState.STOPPED:
            self.sdo.reset()
        if state is NmtState.OPERATIONAL:
            self.pdo.start(time_ns)

    # --- frames in ---------------------------------------------------------------------------------------------

    def _route(self) -> None:
        """Rebuild the table COB-ID -> handler after anything that it depends on changed."""
        routes: dict[int, Callable[[int, bytes, int], None]] = {NMT_ID: self._nmt, LSS_TO_SLAVE_ID: self._lss_frame}
        if self.node_id <= 127:
            receive, transmit = self.pdo.identifiers()
            routes.update(dict.fromkeys(self.consumer.identifiers(), self._heartbeat_frame))
            routes.update(dict.fromkeys(receive, self._rpdo_frame))
            routes.update({t | CAN_RTR_FLAG: self._remote_frame for t in transmit})
            routes[SDO_REQUEST_BASE + self.node_id] = self._sdo_frame
            routes[(HEARTBEAT_BASE + self.node_id) | CAN_RTR_FLAG] = self._guard_frame
            routes[self.dictionary.value(Obj301.SYNC_COB_ID) & 0x7FF] = self._sync_frame
        self._routes = routes

    def _sync_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        if self.state is NmtState.OPERATIONAL:
            self.pdo.on_sync(data, time_ns)

    def _rpdo_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        if self.state is NmtState.OPERATIONAL:
            self.pdo.on_rpdo(can_id, data, time_ns)

    def _remote_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        if self.state is NmtState.OPERATIONAL:
            self.pdo.on_remote(can_id & 0x7FF, time_ns)

    def _sdo_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        if self.state is not NmtState.STOPPED:
            self.sdo.request(data, time_ns)

    def _heartbeat_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        self.consumer.heard(can_id - HEARTBEAT_BASE, data, time_ns)

    def _guard_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        """Node guarding (legacy): the state with a toggle bit."""
        self._put(HEARTBEAT_BASE + self.node_id, bytes((self.state | self._guard_toggle,)), time_ns)
        self._guard_toggle ^= 0x80

    def _lss_frame(self, can_id: int, data: bytes, time_ns: int) -> None:
        self.lss.request(data)

    # --- frames out and events ---------------------------------------------------------------------------------

    def _send_sdo(self, data: bytes) -> None:
        self._put(SDO_ANSWER_BASE + self.node_id, data, self.timeline.now_ns)

    def _send_lss(self, data: bytes) -> None:
        self._put(LSS_FROM_SLAVE_ID, data, self.timeline.now_ns)

    def _send_emergency(self, can_id: int, data: bytes) -> None:
        if self.state in (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL):
            self._put(can_id, data, self.timeline.now_ns)

    def _send_heartbeat(self, time_ns: int) -> None:
        self._put(HEARTBEAT_BASE + self.node_id, bytes((self.state,)), time_ns)

    def _heartbeat_lost(self, node_id: int, time_ns: int) -> None:
        """The last line of defence: EMCY 8130, then the device's reaction (0x6007), then 0x1029."""
        self.emergency.set(Emcy.HEARTBEAT_LOST, time_ns, bytes((node_id,)))
        self.connection_lost(time_ns)
        self._error_behaviour(time_ns)

    def _heartbeat_found(self, node_id: int, time_ns: int) -> None:
        self.emergency.clear(Emcy.HEARTBEAT_LOST, time_ns)

    def _error_behaviour(self, time_ns: int) -> None:
        behaviour = self.dictionary.value(Obj301.ERROR_BEHAVIOUR, 1)
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, time_ns)
        elif behaviour == 2:
            self._enter(NmtState.STOPPED, time_ns)

    def _hook_entries(self) -> None:
        """Let written communication objects act."""
        self.pdo.on_change = self._route
        entry = self.dictionary.entry
        entry(Obj301.SYNC_OVERFLOW).check = _counts_or_not
        entry(Obj301.HEARTBEAT_PRODUCER).written = lambda value: self.producer.restart(self.timeline.now_ns)
        entry(Obj301.SYNC_COB_ID).written = lambda value: self._route()
        for index in range(1, self.dictionary.value(Obj301.HEARTBEAT_CONSUMER) + 1):
            entry(Obj301.HEARTBEAT_CONSUMER, index).written = lambda value: self._watch_heartbeats()

    def _watch_heartbeats(self) -> None:
        self.consumer.configure()
        self._route()


def _counts_or_not(value: int) -> None:
    """0x1019: no counter, or one that runs to 2..240 (CiA 301)."""
    if value == 1:
        raise SdoRefusal(Abort.VALUE_RANGE)
