"""Every kind of bus that servod opens, each as a pair of connections to one wire.

SocketCAN's code runs on a pair of packet sockets everywhere, and on vcan0 where the machine has it.
"""

from __future__ import annotations

import socket
import tempfile
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from servod.drivers.virtual.main import HubServer, Timing
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld, World
from servod.formats.config import BusConfig
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.bus.python_can import PythonCanBus
from servod.runtime.fieldbus.bus.socketcan import SocketCanBus

JOINT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.01, "viscous": 0.05}}


@dataclass
class Wire:
    """Two connections to one bus; `wall` says whether its time stamps are CLOCK_MONOTONIC."""

    one: Bus
    other: Bus
    wall: bool = True
    bounded: bool = True  # whether frames that nobody takes fill the queue


def _model() -> AxisModel:
    return AxisModel.model_validate(JOINT)


@contextmanager
def stepped() -> Iterator[Wire]:
    """The virtual world in this process, in virtual time."""
    world = SteppedWorld(VirtualAxisSettings(queue_depth=16), _model())
    one, other = world.connect(), world.connect()
    world.clock.sleep_until(world.clock.now_ns() + 100_000_000)
    for bus in (one, other):  # the nodes' boot-ups
        while bus.receive(0.0) is not None:
            bus.counters.received = 0
    yield Wire(one, other, wall=False)
    one.close()
    other.close()


@contextmanager
def hub() -> Iterator[Wire]:
    """The virtual bus over its Unix socket, opened by configuration; the nodes have no power and keep quiet."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "bus"
        server = HubServer(World(VirtualAxisSettings(), _model()), path, Timing.STAMPED)
        thread = threading.Thread(target=server.run)
        thread.start()
        stack.callback(server.close)
        stack.callback(thread.join)
        stack.callback(server.stop)
        config = BusConfig(interface="virtual", channel=str(path))
        wire = Wire(open_bus(config), open_bus(config))
        yield wire
        wire.one.close()
        wire.other.close()


@contextmanager
def python_can() -> Iterator[Wire]:
    """python-can's own virtual bus by the adapter; in a configuration its name means servod's virtual bus."""
    channel = uuid.uuid4().hex
    one, other = (PythonCanBus.open("virtual", channel, 1_000_000, {}) for _ in range(2))
    yield Wire(one, other, bounded=False)
    one.close()
    other.close()


@contextmanager
def socket_pair() -> Iterator[Wire]:
    """The code of SocketCAN on two connected packet sockets."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    one, other = (SocketCanBus(end) for end in ends)
    yield Wire(one, other)
    one.close()
    other.close()


@contextmanager
def vcan() -> Iterator[Wire]:
    """Real SocketCAN."""
    config = BusConfig(interface="socketcan", channel="vcan0")
    wire = Wire(open_bus(config), open_bus(config))
    yield wire
    wire.one.close()
    wire.other.close()


BUSES: dict[str, Callable[[], object]] = {
    "stepped": stepped,
    "hub": hub,
    "python-can": python_can,
    "socket-pair": socket_pair,
} | ({"vcan0": vcan} if Path("/sys/class/net/vcan0").exists() else {})
