"""`servod-virtual-axis`: the virtual axis as its own process, on the virtual bus or on SocketCAN.

Where the real machine would be. Prints one line, `ready ...`, when it serves, and ends cleanly on SIGTERM and SIGINT.
SIGUSR1 presses its emergency stop and releases it again, SIGUSR2 opens and closes its STO circuit.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import select
import signal
import socket
import struct
import sys
import time
from enum import Enum
from pathlib import Path
from typing import Any

from servod.common.arguments import ArgumentParser
from servod.common.end_signals import on_end_signals
from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.files import reason
from servod.common.shipped import shipped
from servod.common.units import NS_PER_S
from servod.common.yaml import load_model, validate
from servod.drivers.virtual.bus_faults import BusFault, FaultKind, kind_of
from servod.drivers.virtual.client import STAMPED_FRAME
from servod.drivers.virtual.drive_record import DriveRecord
from servod.drivers.virtual.node import Send, VirtualNode
from servod.drivers.virtual.port import ErrorState, Port
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.drivers.virtual.world import VirtualDevices, World
from servod.formats.config import BusConfig
from servod.formats.model.axis_model import AxisModel, load_rotary_model
from servod.runtime.fieldbus.bus import CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_FLAG, CAN_ERR_RESTARTED, CAN_FRAME, Bus
from servod.runtime.fieldbus.bus.open import open_bus

# --- The hub on a socket ---------------------------------------------------------------------------------------------
# The hub on a Unix socket: accepts clients, carries their frames, on the wall clock, in one thread. The other half of a
# 1 kHz loop in another process, so the way from a SYNC packet to the TPDO packets is short: one select, one receive,
# the event loop of the world, one send for each receiver.


_CRTL_RX_OVERFLOW, _CRTL_TX_PASSIVE, _CRTL_ACTIVE = 0x01, 0x20, 0x40
#: Stamped timing delivers frames at once; the modelled bus may run ahead of the wall clock by this, then frames wait.
LOOK_AHEAD_NS = 1_000_000


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
        self._left = self._unplugged = False

    def fileno(self) -> int:
        """Descriptor for select."""
        return self.socket.fileno()

    @property
    def readable(self) -> bool:
        """Whether its next packet may be read: none of one that left, nor while the transmit queue is full.

        Packets then wait in the socket, until the client's send fails.
        """
        return not self._left and len(self.port.queue) < self.port.depth

    @property
    def gone(self) -> bool:
        """Whether nothing of it is left: what a client sent before it closed still goes out, as SocketCAN has it."""
        return self._unplugged or (self._left and not self.port.queue)

    def take_packet(self) -> None:
        """Read one packet: a frame for the bus, or a request for a fault."""
        try:
            packet = self.socket.recv(CAN_FRAME.size)
        except (BlockingIOError, ConnectionResetError):
            return  # reset: the client closed with frames unread; what it sent is read next
        except OSError:
            packet = b""
        if len(packet) != CAN_FRAME.size:
            self._left = True
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
            pass  # it closed; reading tells when the last of what it sent is there

    def _request(self, fault: BusFault, now_ns: int) -> None:
        if fault.kind is FaultKind.ACCEPT:
            self._accepted = (self._accepted or set()) | {fault.can_id}
        elif fault.kind is FaultKind.HAPPENED:
            asked = fault._replace(kind=kind_of(fault.amount))
            answer = fault._replace(amount=self._world.fault_effect(asked, self.port))
            self.deliver(CAN_ERR_FLAG, answer.encode(), now_ns)
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
        self._unplugged = self._unplugged or not up


class HubServer:
    """Serves `world` at the socket `path` until `stop`. Raises BadInput or Unreachable when it cannot be bound."""

    def __init__(self, world: World, path: Path, timing: Timing) -> None:
        self._world, self._path = world, path
        self.devices = world.devices
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
            readers = [c for c in self._clients if c.readable]
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


# --- The nodes on SocketCAN ------------------------------------------------------------------------------------------
# The same nodes on SocketCAN (vcan or a real interface): no hub, the kernel's bus carries the frames. Each node has its
# own raw socket, as two devices on one wire have their own controllers.


_LONGEST_WAIT_S = 0.1
_BURST = 64

#: Bit of 0x60FD at which the virtual machine's emergency stop gives 24 V while it is released.
ESTOP_CONTACT = 1 << 16


class CanServer:
    """The devices on `buses`, the amplifier's and the encoder's connection, until `stop`."""

    def __init__(
        self, settings: VirtualAxisSettings, model: AxisModel, buses: tuple[Bus, Bus], record: DriveRecord | None
    ) -> None:
        self._timeline = Timeline()
        self._buses = buses
        self.devices = VirtualDevices(settings, model, self._timeline, record)
        self.devices.build(*(_sender(bus) for bus in self._buses))
        self._bus_off = [False, False]
        self._stopping = False

    def stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """The loop: wait for frames or the next deadline, serve both."""
        self.devices.power_on(time.monotonic_ns())
        timeline = self._timeline
        while not self._stopping:
            wait_s = (timeline.next_ns() - time.monotonic_ns()) / NS_PER_S
            select.select(self._buses, (), (), min(max(wait_s, 0.0), _LONGEST_WAIT_S))
            for number, (bus, node) in enumerate(zip(self._buses, self.devices.nodes, strict=True)):
                self._serve(number, bus, node)
            now_ns = time.monotonic_ns()
            while timeline.next_ns() <= now_ns:
                timeline.fire_next()

    def close(self) -> None:
        """Leave the interface."""
        for bus in self._buses:
            bus.close()

    def _serve(self, number: int, bus: Bus, node: VirtualNode) -> None:
        for _ in range(_BURST):
            frame = bus.receive(0.0)
            if frame is None:
                break
            node.receive(*frame)
        off = bus.counters.bus_off
        if off is not self._bus_off[number]:
            self._bus_off[number] = off
            node.bus_state(ErrorState.BUS_OFF if off else ErrorState.ACTIVE, time.monotonic_ns())


def open_pair(interface: str) -> tuple[Bus, Bus]:
    """One connection for each node. Raises Unreachable when the interface is not there."""
    config = BusConfig(interface="socketcan", channel=interface)
    return open_bus(config), open_bus(config)


def _sender(bus: Bus) -> Send:
    return lambda can_id, data, time_ns: bus.send(can_id, data)


_EXAMPLE = (
    "SIGUSR1 presses the emergency stop (bit 16 of 0x60FD) and releases it, SIGUSR2 opens and closes the STO circuit "
    "(bit 17). example: servod-virtual-axis --socket /tmp/vbus0 --plant joint.yaml --record drive.bin --seed 7"
)
#: Options that override a key of the settings, with their types.
_SETTING_OPTIONS: dict[str, type] = {
    "seed": int,
    "bit-rate": int,
    "amplifier-node-id": int,
    "encoder-node-id": int,
    "amplifier-counts-per-turn": int,
    "encoder-counts-per-turn": int,
    "encoder-measuring-range-counts": int,
    "gear-ratio": float,
    "rated-torque-mnm": int,
}
_OVERRIDES = "overrides the settings file"
_SETTING_HELP = {"seed": f"begins the noise: the same number, the same noise; {_OVERRIDES}"}


def parser() -> argparse.ArgumentParser:
    """What `servod-virtual-axis` takes; the reference of the command line prints it too."""
    found = ArgumentParser(prog="servod-virtual-axis", description="A virtual servo axis.", epilog=_EXAMPLE)
    bus = found.add_mutually_exclusive_group(required=True)
    bus.add_argument("--socket", type=Path, metavar="PATH", help="serve a virtual CAN bus at this Unix socket")
    bus.add_argument("--can", metavar="INTERFACE", help="join a SocketCAN interface, e.g. vcan0")
    found.add_argument("--plant", type=Path, metavar="FILE", help="axis model of the joint (default: demo joint)")
    found.add_argument("--settings", type=Path, metavar="FILE", help="settings of the virtual axis (YAML)")
    found.add_argument("--record", type=Path, metavar="FILE", help="the drive's own record, survives any kill")
    timing = "frames come at once with the bus's time on them (stamped), or when they have really ended (paced)"
    found.add_argument("--timing", choices=[t.value for t in Timing], default=Timing.STAMPED.value, help=timing)
    scheduler = "SCHED_FIFO priority, below the loop's; 0 leaves the scheduler alone (default: 40)"
    found.add_argument("--priority", type=int, choices=range(99), metavar="N", default=40, help=scheduler)
    for option, kind in _SETTING_OPTIONS.items():
        found.add_argument(f"--{option}", type=kind, metavar="N", help=_SETTING_HELP.get(option, _OVERRIDES))
    return found


def _settings(arguments: argparse.Namespace) -> VirtualAxisSettings:
    """The settings file, or the defaults, with the options on top; raises BadInput."""
    base = load_model(arguments.settings, VirtualAxisSettings) if arguments.settings else VirtualAxisSettings()
    chosen: dict[str, Any] = {o.replace("-", "_"): getattr(arguments, o.replace("-", "_")) for o in _SETTING_OPTIONS}
    given = {key: value for key, value in chosen.items() if value is not None}
    return validate(base.model_dump() | given, VirtualAxisSettings, "options")


def _server(arguments: argparse.Namespace) -> HubServer | CanServer:
    """Everything built and bound, ready to run; raises ServodError."""
    settings = _settings(arguments)
    model = load_rotary_model(arguments.plant or shipped("gains/axes/demo_joint.yaml"))
    record = DriveRecord(arguments.record) if arguments.record else None
    if arguments.can:
        return CanServer(settings, model, open_pair(arguments.can), record)
    world = World(settings, model, record)
    server = HubServer(world, arguments.socket, Timing(arguments.timing))
    world.devices.power_on(time.monotonic_ns())
    return server


def _on_circuit_signals(devices: VirtualDevices) -> None:
    """Let SIGUSR1 and SIGUSR2 turn what a person at the machine would: its emergency stop and its STO circuit."""
    contacts, safe_torque_off = (devices.nodes[0].dictionary.entry(0x2000, sub) for sub in (7, 2))

    def press(*_: object) -> None:
        contacts.value ^= ESTOP_CONTACT

    def open_circuit(*_: object) -> None:
        safe_torque_off.value ^= 1

    signal.signal(signal.SIGUSR1, press)
    signal.signal(signal.SIGUSR2, open_circuit)


def _take_turns_first(priority: int) -> str:
    """Ask for real-time scheduling: an axis that queues behind ordinary processes answers late; a note if refused."""
    if priority == 0:
        return ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return f" (without SCHED_FIFO {priority}: {error.strerror})"
    return ""


def main(argv: list[str] | None = None) -> int:
    """Run until told to stop; returns its exit code (servod.common.errors)."""
    try:
        arguments = parser().parse_args(argv)
        server = _server(arguments)
    except ServodError as error:
        print(f"servod-virtual-axis: {error}", file=sys.stderr)
        return error.exit_code
    on_end_signals(server.stop)
    _on_circuit_signals(server.devices)
    gc.freeze()  # what stands now stays; collections in the loop then have little to look at
    print(f"ready {arguments.can or arguments.socket}{_take_turns_first(arguments.priority)}", flush=True)
    try:
        server.run()
    finally:
        with contextlib.suppress(OSError):  # ending takes long, and others run before it
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
