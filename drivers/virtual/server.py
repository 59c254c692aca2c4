"""The hub on a Unix socket: accepts clients, carries their frames, on the wall clock, in one thread.

The other half of a 1 kHz loop in another process, so the way from a SYNC packet to the TPDO packets is short: one
select, one receive, the event loop of the world, one send for each receiver.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from enum import Enum
from pathlib import Path

from servod.common.errors import BadInput, Unreachable
from servod.common.files import reason
from servod.common.units import NS_PER_S
from servod.drivers.virtual.bus_faults import BusFault, FaultKind, kind_of
from servod.drivers.virtual.client import STAMPED_FRAME
from servod.drivers.virtual.port import ErrorState, Port
from servod.drivers.virtual.world import World
from servod.runtime.fieldbus.bus import CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_FLAG, CAN_ERR_RESTARTED, CAN_FRAME

_CRTL_RX_OVERFLOW, _CRTL_TX_PASSIVE, _CRTL_ACTIVE = 0x01, 0x20, 0x40
#: Stamped timing delivers frames at once; the modelled bus may run ahead of the wall clock by this, then frames wait.
LOOK_AHEAD_NS = 1_000_000
_LONGEST_WAIT_S = 0.1


class Timing(Enum):
    """When frames are delivered in wall time."""

    STAMPED = "stamped"  # at once, in arbitration order, stamped with the time of the modelled bus
    PACED = "paced"  # when the frame has really ended


class Client:
    """One connected client and its CAN controller on the hub."""

    def __init__(self, sock: socket.socket, world: World) -> None:
        self.socket, self._world = sock, world
        sock.setblocking(False)
        settings = world.settings
        self.port = Port("client", self.deliver, settings.queue_depth, settings.client_restart_ms * 1_000_000)
        self.port.on_state, self.port.on_link = self._state_changed, self._link_changed
        self._accepted: set[int] | None = None
        self._overflow = False
        self.gone = False

    def fileno(self) -> int:
        """Descriptor for select."""
        return self.socket.fileno()

    @property
    def writable(self) -> bool:
        """False while the transmit queue is full: packets then wait in the socket, until the client's send fails."""
        return len(self.port.queue) < self.port.depth

    def take_packet(self) -> None:
        """Read one packet: a frame for the bus, or a request for a fault."""
        try:
            packet = self.socket.recv(CAN_FRAME.size)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if len(packet) != CAN_FRAME.size:
            self.gone = True
            return
        can_id, length, data = CAN_FRAME.unpack(packet)
        now_ns = time.monotonic_ns()
        if can_id & CAN_ERR_FLAG:
            self._request(BusFault.decode(data), now_ns)
        elif length <= 8:
            self._world.hub.submit(self.port, can_id, data[:length], now_ns)

    def deliver(self, can_id: int, data: bytes, time_ns: int) -> None:
        """Hand a frame to the client; one that does not read loses frames, and is told."""
        if self._accepted is not None and can_id not in self._accepted and not can_id & CAN_ERR_FLAG:
            return
        try:
            if self._overflow:
                overflow = bytes((0, _CRTL_RX_OVERFLOW)).ljust(8, b"\0")
                self.socket.send(STAMPED_FRAME.pack(CAN_ERR_FLAG | CAN_ERR_CRTL, 8, overflow, time_ns))
                self._overflow = False
            self.socket.send(STAMPED_FRAME.pack(can_id, len(data), data, time_ns))
        except BlockingIOError:
            self._overflow = True
        except OSError:
            self.gone = True

    def _request(self, fault: BusFault, now_ns: int) -> None:
        if fault.kind is FaultKind.ACCEPT:
            self._accepted = (self._accepted or set()) | {fault.can_id}
        elif fault.kind is FaultKind.HAPPENED:
            asked = fault._replace(kind=kind_of(fault.amount))
            told = fault._replace(amount=self._world.fault_effect(asked, self.port))
            self.deliver(CAN_ERR_FLAG, told.encode(), now_ns)
        else:
            self._world.apply_fault(fault, self.port, now_ns)

    def _state_changed(self, state: ErrorState, time_ns: int) -> None:
        """Tell the client as SocketCAN does: an error frame with the class, the controller's state and the counters."""
        error_class, controller = CAN_ERR_CRTL, _CRTL_TX_PASSIVE
        if state is ErrorState.BUS_OFF:
            error_class, controller = CAN_ERR_BUSOFF, 0
        elif state is ErrorState.ACTIVE:
            error_class, controller = CAN_ERR_CRTL | CAN_ERR_RESTARTED, _CRTL_ACTIVE
        counts = (min(self.port.transmit_errors, 255), min(self.port.receive_errors, 255))
        data = struct.pack("<BB4xBB", 0, controller, *counts)
        self.deliver(CAN_ERR_FLAG | error_class, data, time_ns)

    def _link_changed(self, up: bool, time_ns: int) -> None:
        """An interface that goes down ends the connection, and nothing but a new one brings it back."""
        self.gone = self.gone or not up


class HubServer:
    """Serves `world` at the socket `path` until `stop`. Raises BadInput or Unreachable when it cannot be bound."""

    def __init__(self, world: World, path: Path, timing: Timing) -> None:
        self._world, self._path = world, path
        self._look_ahead_ns = LOOK_AHEAD_NS if timing is Timing.STAMPED else 0
        self._listener = _listen(path)
        self._clients: list[Client] = []
        self._stopping = False

    def stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """The loop: wait, read one packet of each client, let the world go on."""
        world = self._world
        now_ns = time.monotonic_ns()
        while not self._stopping:
            wait_s = (world.next_ns() - self._look_ahead_ns - now_ns) / NS_PER_S if self._behind else self._idle(now_ns)
            readers = [c for c in self._clients if c.writable]
            sources: list[socket.socket | Client] = [self._listener, *readers]
            ready = select.select(sources, (), (), min(max(wait_s, 0.0), _LONGEST_WAIT_S))[0]
            for source in ready:
                if isinstance(source, Client):
                    source.take_packet()
                else:
                    self._accept()
            now_ns = time.monotonic_ns()
            world.advance(now_ns, now_ns + self._look_ahead_ns)
            if any(client.gone for client in self._clients):
                self._drop_gone()

    def close(self) -> None:
        """Close all sockets and take the path away."""
        for client in self._clients:
            client.socket.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    @property
    def _behind(self) -> bool:
        """True while frames wait because the modelled bus is busy."""
        return self._world.hub.next_ns() < self._world.timeline.next_ns()

    def _idle(self, now_ns: int) -> float:
        return (self._world.timeline.next_ns() - now_ns) / NS_PER_S

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            client = Client(self._listener.accept()[0], self._world)
            self._clients.append(client)
            self._world.hub.attach(client.port)

    def _drop_gone(self) -> None:
        for client in [c for c in self._clients if c.gone]:
            self._clients.remove(client)
            self._world.hub.detach(client.port)
            client.socket.close()


def _listen(path: Path) -> socket.socket:
    """Bind and listen; a socket that nobody serves any more is replaced, a served one refused."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        if path.is_socket():
            if _served(path):
                raise Unreachable(f"virtual bus {path}: another virtual axis serves there")
            path.unlink()
        listener.bind(str(path))
        listener.listen(16)
    except OSError as error:
        listener.close()
        found = reason(error)
        if not path.parent.is_dir():
            found = f"no folder {path.parent}"
        raise BadInput(f"--socket {path}", found, "a path for a new socket in a folder that is there") from None
    listener.setblocking(False)
    return listener


def _served(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        return probe.connect_ex(str(path)) == 0
