"""Carries out the faults that a client of the bus asks for: on frames, on participants, and by further participants.

Beside the world: `inject` looks up what a kind of fault does; the hub then lets it happen to the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from servod.cia import SYNC_ID
from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, BusFault, FaultKind
from servod.drivers.virtual.port import Port

if TYPE_CHECKING:
    from servod.drivers.virtual.world import World

_MS_NS, _US_NS = 1_000_000, 1_000
#: A babbler that takes all it can get has so many frames waiting at each millisecond.
_FLOOD = 20
_BABBLE = bytes(8)


def inject(world: World, fault: BusFault, client: Port, time_ns: int) -> None:
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
        port = client if fault.participant == MYSELF else world.port_of(fault.participant)
        if port is not None:
            _ON_PORT[fault.kind](world, port, fault.amount, time_ns)


def _bus_off(world: World, port: Port, _amount: int, time_ns: int) -> None:
    world.hub.force_bus_off(port, time_ns)


def _silence(_world: World, port: Port, amount: int, time_ns: int) -> None:
    port.silent_until_ns = time_ns + amount * _MS_NS


def _delay(_world: World, port: Port, amount: int, _time_ns: int) -> None:
    port.delay_ns = amount * _US_NS


def _stick(_world: World, port: Port, amount: int, time_ns: int) -> None:
    port.stuck_until_ns = time_ns + amount * _MS_NS


def _take_down(world: World, port: Port, amount: int, time_ns: int) -> None:
    _silence(world, port, amount, time_ns)
    port.on_link(False, time_ns)
    world.timeline.timer(lambda up_ns: port.on_link(True, up_ns)).arm(port.silent_until_ns)


_ON_PORT: dict[FaultKind, Callable[[World, Port, int, int], None]] = {
    FaultKind.BUS_OFF: _bus_off,
    FaultKind.SILENT: _silence,
    FaultKind.DELAY: _delay,
    FaultKind.STUCK: _stick,
    FaultKind.DOWN: _take_down,
}


class _Babbler:
    """A further participant that sends one identifier again and again, until its time is over."""

    def __init__(self, world: World, fault: BusFault, time_ns: int) -> None:
        self._hub = world.hub
        self._port = world.hub.attach(Port("babbler", _hear_nothing, depth=_FLOOD))
        self._can_id, self._each_ms = fault.can_id, fault.detail or _FLOOD
        self._data = b"" if fault.can_id == SYNC_ID else _BABBLE
        self._until_ns = time_ns + fault.amount * _MS_NS
        self._timer = world.timeline.timer(self._send)
        self._timer.arm(time_ns + _MS_NS // 2)

    def _send(self, time_ns: int) -> None:
        if time_ns >= self._until_ns:
            self._hub.detach(self._port)
            return
        for _ in range(self._each_ms):
            if not self._hub.submit(self._port, self._can_id, self._data, time_ns):
                break
        self._timer.arm(time_ns + _MS_NS)


def _hear_nothing(can_id: int, data: bytes, time_ns: int) -> None:
    """A babbler does not listen."""
