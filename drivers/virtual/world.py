"""The virtual world: hub, nodes and joint on one time line; and the SYNC-stepped clock that drives it in one process.

`World` is the same on wall and virtual time: somebody calls `advance`. `SteppedWorld` is that somebody in virtual
time: a clock whose sleep lets the world run, and connections whose waiting lets it run.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from servod.common.units import NS_PER_S
from servod.drivers.virtual.amplifier import AmplifierNode
from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, SUBINDEX_SHIFT, BusFault, FaultKind
from servod.drivers.virtual.drive_record import DriveRecord
from servod.drivers.virtual.encoder import EncoderNode
from servod.drivers.virtual.hub import Hub
from servod.drivers.virtual.joint import Joint
from servod.drivers.virtual.node import Send, VirtualNode
from servod.drivers.virtual.port import ErrorState, Port
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.formats.model.axis_model import AxisModel, rotary
from servod.runtime.fieldbus.bus import BusCounters, Frame
from servod.runtime.fieldbus.cia import SYNC_ID

# --- Carrying out faults ---------------------------------------------------------------------------------------------
# Carries out the faults that a client of the bus asks for: on frames, on participants, and by further participants.
# `inject` looks up what a kind of fault does; the hub then lets it happen to the frames. `happened` says how often it
# did.


_INJECTION_MS_NS, _US_NS = 1_000_000, 1_000
#: A babbler that takes all it can get has so many frames waiting at each millisecond.
_FLOOD = 20
_BABBLE = bytes(8)


class Participants(Protocol):
    """What faults act on: the hub, its time, and who takes part. The world is one."""

    hub: Hub
    timeline: Timeline
    babbled: Counter[int]  # frames of each identifier that babblers have sent
    twins: list[tuple[int, Port]]  # second nodes with a number that is taken
    written: int  # objects that were changed past the bus

    def switch_on_twin(self, node_id: int, time_ns: int) -> None:
        """Switch on a second node with this number."""

    def write(self, node_id: int, index: int, subindex: int, value: int) -> bool:
        """Change an object of a node past the bus."""

    def port_of(self, participant: int) -> Port | None:
        """The connection of a node, None when it is not there."""


def inject(world: Participants, fault: BusFault, client: Port, time_ns: int) -> None:
    """Let `fault` happen from `time_ns` on; `client` is who asked. A participant that is not there changes nothing."""
    if fault.kind in FRAME_KINDS:
        world.hub.faults.arm(fault.kind, fault.can_id, fault.amount, fault.detail)
    elif fault.kind is FaultKind.CLEAR:
        world.hub.faults.clear()
    elif fault.kind is FaultKind.BABBLE:
        _Babbler(world, fault, time_ns)
    elif fault.kind is FaultKind.TWIN:
        world.switch_on_twin(fault.participant, time_ns)
    elif fault.kind is FaultKind.WRITE:
        subindex, value = divmod(fault.amount, 1 << SUBINDEX_SHIFT)
        world.write(fault.participant, fault.can_id, subindex, value)
    elif fault.kind in _ON_PORT:
        port = _port(world, fault, client)
        if port is not None:
            _ON_PORT[fault.kind](world, port, fault.amount, time_ns)


def happened(world: Participants, fault: BusFault, client: Port) -> int:
    """How often what `fault` asks for took effect so far, whoever asked for it: frames that were struck, lost, held
    back or sent by strangers, or times of bus-off and of an interface that went down. Its amount and detail do not
    matter."""
    if fault.kind in FRAME_KINDS:
        return world.hub.faults.struck[fault.kind, fault.can_id]
    if fault.kind is FaultKind.CLEAR:
        return world.hub.faults.cleared
    if fault.kind is FaultKind.BABBLE:
        return world.babbled[fault.can_id]
    if fault.kind is FaultKind.WRITE:
        return world.written
    if fault.kind is FaultKind.TWIN:
        return sum(port.sent for node_id, port in world.twins if node_id == fault.participant)
    port = _port(world, fault, client) if fault.kind in _LEFT_ON_PORT else None
    return 0 if port is None else _LEFT_ON_PORT[fault.kind](port)


def _port(world: Participants, fault: BusFault, client: Port) -> Port | None:
    return client if fault.participant == MYSELF else world.port_of(fault.participant)


def _bus_off(world: Participants, port: Port, _amount: int, time_ns: int) -> None:
    world.hub.force_bus_off(port, time_ns)


def _silence(_world: Participants, port: Port, amount: int, time_ns: int) -> None:
    port.silent_until_ns = time_ns + amount * _INJECTION_MS_NS


def _delay(_world: Participants, port: Port, amount: int, _time_ns: int) -> None:
    port.delay_ns = amount * _US_NS


def _stick(_world: Participants, port: Port, amount: int, time_ns: int) -> None:
    port.stuck_until_ns = time_ns + amount * _INJECTION_MS_NS


def _take_down(world: Participants, port: Port, amount: int, time_ns: int) -> None:
    _silence(world, port, amount, time_ns)
    port.downs += 1
    port.on_link(False, time_ns)
    world.timeline.timer(lambda up_ns: port.on_link(True, up_ns)).arm(port.silent_until_ns)


_ON_PORT: dict[FaultKind, Callable[[Participants, Port, int, int], None]] = {
    FaultKind.BUS_OFF: _bus_off,
    FaultKind.SILENT: _silence,
    FaultKind.DELAY: _delay,
    FaultKind.STUCK: _stick,
    FaultKind.DOWN: _take_down,
}
_LEFT_ON_PORT: dict[FaultKind, Callable[[Port], int]] = {
    FaultKind.BUS_OFF: lambda port: port.bus_offs,
    FaultKind.SILENT: lambda port: port.silenced,
    FaultKind.DELAY: lambda port: port.held,
    FaultKind.STUCK: lambda port: port.held,
    FaultKind.DOWN: lambda port: port.downs,
}


class _Babbler:
    """A further participant that sends one identifier again and again, until its time is over."""

    def __init__(self, world: Participants, fault: BusFault, time_ns: int) -> None:
        self._hub, self._babbled, self._counted = world.hub, world.babbled, 0
        self._port = world.hub.attach(Port("babbler", _hear_nothing, depth=_FLOOD))
        self._can_id, self._each_ms = fault.can_id, fault.detail or _FLOOD
        self._data = b"" if fault.can_id == SYNC_ID else _BABBLE
        self._until_ns = time_ns + fault.amount * _INJECTION_MS_NS
        self._timer = world.timeline.timer(self._send)
        self._timer.arm(time_ns + _INJECTION_MS_NS // 2)

    def _send(self, time_ns: int) -> None:
        self._babbled[self._can_id] += self._port.sent - self._counted
        self._counted = self._port.sent
        if time_ns >= self._until_ns:
            self._hub.detach(self._port)
            return
        for _ in range(self._each_ms):
            if not self._hub.submit(self._port, self._can_id, self._data, time_ns):
                break
        self._timer.arm(time_ns + _INJECTION_MS_NS)


def _hear_nothing(can_id: int, data: bytes, time_ns: int) -> None:
    """A babbler does not listen."""


__all__ = ["SteppedBus", "SteppedClock", "SteppedWorld", "Truth", "VirtualAxisSettings", "World"]

_NODE_QUEUE = 1024
_RECEIVE_QUEUE = 65_536
_MS_NS = 1_000_000


class Truth(NamedTuple):
    """What the joint really does, and what nobody on the bus can see."""

    time_ns: int
    position_rad: float
    velocity_rad_s: float
    torque_nm: float


class VirtualDevices:
    """The amplifier, the encoder and the joint between them; `build` gives each node its way to the bus.

    Raises BadInput for the model of a linear axis.
    """

    def __init__(
        self, settings: VirtualAxisSettings, model: AxisModel, timeline: Timeline, record: DriveRecord | None = None
    ) -> None:
        self.settings, self.timeline = settings, timeline
        self.joint = Joint(rotary(model, "plant"), settings.seed, settings.cycle_period_s, settings.brake_nm)
        if settings.start_position_rad:
            self.joint.plant.place(settings.start_position_rad)
        self._record = record
        self.nodes: tuple[VirtualNode, ...] = ()

    def build(self, amplifier_send: Send, encoder_send: Send) -> tuple[AmplifierNode, EncoderNode]:
        """Make both nodes; `power_on` starts them."""
        amplifier = AmplifierNode(self.settings, self.joint, self.timeline, amplifier_send, self._record)
        encoder = EncoderNode(self.settings, self.joint, self.timeline, encoder_send)
        self.nodes = (amplifier, encoder)
        return amplifier, encoder

    def power_on(self, time_ns: int) -> None:
        """Both nodes boot."""
        self.joint.advance(time_ns)
        for node in self.nodes:
            node.power_on(time_ns)


class World:
    """Hub and devices; nothing happens unless `advance` is called. `babbled` counts the frames of babblers that the bus
    carried, by identifier; `twins` are the second nodes that were switched on, by node id; `written` counts objects
    that were changed past the bus."""

    def __init__(self, settings: VirtualAxisSettings, model: AxisModel, record: DriveRecord | None = None) -> None:
        self.settings, self._model = settings, model
        self.timeline = Timeline()
        self.hub = Hub(self.timeline, settings.bit_rate)
        self._next_timer_ns, self._step_bus = self.timeline.next_ns, self.hub.step  # looked up once: for every event
        self.babbled: Counter[int] = Counter()
        self.twins: list[tuple[int, Port]] = []
        self.written = 0
        self.devices = VirtualDevices(settings, model, self.timeline, record)
        self._node_ports = {name: self._node_port(name) for name in ("amplifier", "encoder")}
        sends = [self.sender(port) for port in self._node_ports.values()]
        self.amplifier, self.encoder = self.devices.build(*sends)
        for port, node in zip(self._node_ports.values(), self.devices.nodes, strict=True):
            port.receive, port.on_state = node.receive, node.bus_state

    def sender(self, port: Port) -> Send:
        """The way to the bus for whoever owns `port`."""
        submit = self.hub.submit
        return lambda can_id, data, time_ns: submit(port, can_id, data, time_ns)

    def advance(self, now_ns: int, bus_ns: int | None = None) -> None:
        """Let everything happen that is due by `now_ns`; frames may complete until `bus_ns`, where that is later."""
        while self.advance_once(now_ns, now_ns if bus_ns is None else bus_ns):
            pass

    def advance_once(self, now_ns: int, bus_ns: int) -> bool:
        """The next single event; False when none is due."""
        timer_ns = self._next_timer_ns()
        if self._step_bus(timer_ns if timer_ns <= now_ns else bus_ns):
            return True
        if timer_ns <= now_ns:
            self.timeline.fire_next()
            return True
        return False

    def next_ns(self) -> int:
        """When the next event is due."""
        return min(self.timeline.next_ns(), self.hub.next_ns())

    def apply_fault(self, fault: BusFault, client: Port, time_ns: int) -> None:
        """Carry out a fault that a client asked for."""
        inject(self, fault, client, time_ns)

    def fault_effect(self, fault: BusFault, client: Port) -> int:
        """How often what a client asks for took effect so far."""
        return happened(self, fault, client)

    def switch_on_twin(self, node_id: int, time_ns: int) -> None:
        """A second node with this id, on a joint of its own, is switched on: somebody set the same address twice."""
        twins = VirtualDevices(self.settings, self._model, self.timeline)
        ports = [self._node_port(f"twin {name}") for name in self._node_ports]
        twins.build(*[self.sender(port) for port in ports])
        for port, twin in zip(ports, twins.nodes, strict=True):
            if twin.node_id == node_id:
                port.receive, port.on_state = twin.receive, twin.bus_state
                self.twins.append((node_id, port))
                twins.joint.advance(time_ns)
                twin.power_on(time_ns)
            else:
                self.hub.detach(port)

    def write(self, node_id: int, index: int, subindex: int, value: int) -> bool:
        """Change an object of a node past the bus, straight in its dictionary; True when it keeps the value."""
        took = False
        for node in self.devices.nodes:
            if node.node_id != node_id or not node.dictionary.has(index, subindex):
                continue
            entry = node.dictionary.entry(index, subindex)
            if entry.writable:
                entry.value = value
                if entry.written is not None:
                    entry.written(value)
                took = entry.value == value
        self.written += took
        return took

    def port_of(self, node_id: int) -> Port | None:
        """The CAN controller of a node."""
        for port, node in zip(self._node_ports.values(), self.devices.nodes, strict=True):
            if node.node_id == node_id:
                return port
        return None

    def truth(self, time_ns: int) -> Truth:
        """The joint's true state."""
        joint = self.devices.joint
        return Truth(time_ns, joint.plant.position_rad, joint.plant.velocity_rad_s, joint.torque_nm)

    def _node_port(self, name: str) -> Port:
        port = Port(name, _deaf, depth=_NODE_QUEUE, restart_ns=self.settings.node_restart_ms * _MS_NS)
        return self.hub.attach(port)


class SteppedClock:
    """servod.common.clock.Clock of the stepped world: sleeping is what makes time pass."""

    def __init__(self, world: World, start_ns: int) -> None:
        self._world, self._now_ns = world, start_ns

    def now_ns(self) -> int:
        """Present virtual time."""
        return self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Let the world run until `deadline_ns`."""
        if deadline_ns > self._now_ns:
            self._world.advance(deadline_ns)
            self._now_ns = deadline_ns

    def reach(self, time_ns: int) -> None:
        """An event at `time_ns` has happened."""
        self._now_ns = max(self._now_ns, time_ns)


class SteppedBus:
    """servod.runtime.fieldbus.bus.Bus inside the process; `receive` lets virtual time pass until a frame comes."""

    def __init__(self, world: World, clock: SteppedClock, can_ids: tuple[int, ...] | None = None) -> None:
        self._world, self._clock = world, clock
        self._accepted = None if can_ids is None else frozenset(can_ids)
        self._frames: deque[Frame] = deque()
        self.counters = BusCounters()
        settings = world.settings
        restart_ns = settings.client_restart_ms * _MS_NS
        self.port = Port("client", self._deliver, depth=settings.queue_depth, restart_ns=restart_ns)
        self.port.on_state, self.port.on_link = self._state_changed, self._link_changed
        world.hub.attach(self.port)

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame; False and counted when the queue is full or the bus off or down."""
        counters = self.counters
        if counters.down or not self._world.hub.submit(self.port, can_id, data, self._clock.now_ns()):
            counters.queue_full += 0 if counters.down or counters.bus_off else 1
            return False
        counters.sent += 1
        return True

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next frame; virtual time passes up to `timeout_s` until one comes."""
        frames, clock = self._frames, self._clock
        if not frames:
            until_ns = clock.now_ns() + int(timeout_s * NS_PER_S)
            world = self._world
            while not frames:
                if not world.advance_once(until_ns, until_ns):
                    clock.reach(until_ns)
                    return None
        frame = frames.popleft()
        clock.reach(frame.time_ns)
        self.counters.received += 1
        return frame

    def inject(self, fault: BusFault) -> None:
        """Ask the hub for a fault."""
        self._world.apply_fault(fault, self.port, self._clock.now_ns())

    def happened(self, fault: BusFault) -> int:
        """How often what `fault` asks for took effect so far."""
        return self._world.fault_effect(fault, self.port)

    def fileno(self) -> int:
        """No descriptor: this bus is in the process."""
        return -1

    def close(self) -> None:
        """Leave the bus."""
        self.counters.set_down()
        self._world.hub.detach(self.port)

    def _deliver(self, can_id: int, data: bytes, time_ns: int) -> None:
        """Take a frame that passes the filter; one that nobody reads away is lost, as in a socket's full buffer."""
        if self._accepted is not None and can_id not in self._accepted:
            return
        if len(self._frames) < _RECEIVE_QUEUE:
            self._frames.append(Frame(can_id, data, time_ns))
        else:
            self.counters.error_frames += 1

    def _state_changed(self, state: ErrorState, time_ns: int) -> None:
        self.counters.error_frames += 1
        if state is ErrorState.BUS_OFF:
            self.counters.set_bus_off()
        else:
            self.counters.bus_off = False
        self.counters.error_passive = state is ErrorState.PASSIVE

    def _link_changed(self, up: bool, time_ns: int) -> None:
        if up:
            self.counters.down = False
        else:
            self.counters.set_down()


class SteppedWorld(World):
    """The virtual axis in one process and virtual time: deterministic, as fast as it computes."""

    def __init__(
        self,
        settings: VirtualAxisSettings,
        plant_model: AxisModel,
        record: DriveRecord | None = None,
        start_ns: int = NS_PER_S,
    ) -> None:
        super().__init__(settings, plant_model, record)
        self.clock = SteppedClock(self, start_ns)
        self.devices.power_on(start_ns)

    def connect(self, can_ids: tuple[int, ...] | None = None) -> SteppedBus:
        """A new connection to the bus; with `can_ids`, only these reach it."""
        return SteppedBus(self, self.clock, can_ids)

    def truth(self, time_ns: int | None = None) -> Truth:
        """The joint's true state at the present virtual time."""
        self.devices.joint.advance(self.clock.now_ns())
        return super().truth(self.clock.now_ns() if time_ns is None else time_ns)


def _deaf(can_id: int, data: bytes, time_ns: int) -> None:
    """Receiver of a port whose node is not built yet."""
