"""Carries out the faults that a client of the bus asks for: on frames, on participants, and by further participants.

Beside the world: `inject` looks up what a kind of fault does; the hub then lets it happen to the frames. `happened`
says how often it did.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Protocol

from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, BusFault, FaultKind
from servod.drivers.virtual.hub import Hub
from servod.drivers.virtual.port import Port
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.cia import SYNC_ID

_MS_NS, _US_NS = 1_000_000, 1_000
#: A babbler that takes all it can get has so many frames waiting at each millisecond.
_FLOOD = 20
_BABBLE = bytes(8)


class Participants(Protocol):
    """What faults act on: the hub, its time, and who takes part. The world is one."""

    hub: Hub
    timeline: Timeline
    babbled: Counter[int]  # frames of each identifier that babblers have sent
    twins: list[tuple[int, Port]]  # second nodes with a number that is taken

    def switch_on_twin(self, node_id: int, time_ns: int) -> None:
        """Switch on a second node with this number."""

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
    if fault.kind is FaultKind.TWIN:
        return sum(port.sent for node_id, port in world.twins if node_id == fault.participant)
    port = _port(world, fault, client) if fault.kind in _LEFT_ON_PORT else None
    return 0 if port is None else _LEFT_ON_PORT[fault.kind](port)


def _port(world: Participants, fault: BusFault, client: Port) -> Port | None:
    return client if fault.participant == MYSELF else world.port_of(fault.participant)


def _bus_off(world: Participants, port: Port, _amount: int, time_ns: int) -> None:
    world.hub.force_bus_off(port, time_ns)


def _silence(_world: Participants, port: Port, amount: int, time_ns: int) -> None:
    port.silent_until_ns = time_ns + amount * _MS_NS


def _delay(_world: Participants, port: Port, amount: int, _time_ns: int) -> None:
    port.delay_ns = amount * _US_NS


def _stick(_world: Participants, port: Port, amount: int, time_ns: int) -> None:
    port.stuck_until_ns = time_ns + amount * _MS_NS


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
        self._until_ns = time_ns + fault.amount * _MS_NS
        self._timer = world.timeline.timer(self._send)
        self._timer.arm(time_ns + _MS_NS // 2)

    def _send(self, time_ns: int) -> None:
        self._babbled[self._can_id] += self._port.sent - self._counted
        self._counted = self._port.sent
        if time_ns >= self._until_ns:
            self._hub.detach(self._port)
            return
        for _ in range(self._each_ms):
            if not self._hub.submit(self._port, self._can_id, self._data, time_ns):
                break
        self._timer.arm(time_ns + _MS_NS)


def _hear_nothing(can_id: int, data: bytes, time_ns: int) -> None:
    """A babbler does not listen."""
