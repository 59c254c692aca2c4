"""`servod-virtual-axis`: the virtual axis as its own process, on the virtual bus or on SocketCAN.

Where the real machine would be. Prints one line, `ready ...`, when it serves, and ends cleanly on SIGTERM and SIGINT.
"""

from __future__ import annotations

import argparse
import gc
import os
import select
import sys
import time
from pathlib import Path
from typing import Any

from servod.common.errors import ServodError
from servod.common.shipped import shipped
from servod.common.units import NS_PER_S
from servod.common.workers import on_end_signals
from servod.common.yaml import load_model, validate
from servod.drivers.virtual.drive_record import DriveRecord
from servod.drivers.virtual.node import Node, Send
from servod.drivers.virtual.port import ErrorState
from servod.drivers.virtual.server import HubServer, Timing
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.drivers.virtual.world import Devices, World
from servod.formats.config import BusConfig
from servod.formats.model.axis_model import AxisModel, load_rotary_model
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus

# The same nodes on SocketCAN (vcan or a real interface): no hub, the kernel's bus carries the frames.
#
# Each node has its own raw socket, as two devices on one wire have their own controllers.


_LONGEST_WAIT_S = 0.1
_BURST = 64


class CanServer:
    """The devices on `buses`, the amplifier's and the encoder's connection, until `stop`."""

    def __init__(
        self, settings: VirtualAxisSettings, model: AxisModel, buses: tuple[Bus, Bus], record: DriveRecord | None
    ) -> None:
        self._timeline = Timeline()
        self._buses = buses
        self._devices = Devices(settings, model, self._timeline, record)
        self._devices.build(*(_sender(bus) for bus in self._buses))
        self._bus_off = [False, False]
        self._stopping = False

    def stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """The loop: wait for frames or the next deadline, serve both."""
        self._devices.power_on(time.monotonic_ns())
        timeline = self._timeline
        while not self._stopping:
            wait_s = (timeline.next_ns() - time.monotonic_ns()) / NS_PER_S
            select.select(self._buses, (), (), min(max(wait_s, 0.0), _LONGEST_WAIT_S))
            for number, (bus, node) in enumerate(zip(self._buses, self._devices.nodes, strict=True)):
                self._serve(number, bus, node)
            now_ns = time.monotonic_ns()
            while timeline.next_ns() <= now_ns:
                timeline.fire_next()

    def close(self) -> None:
        """Leave the interface."""
        for bus in self._buses:
            bus.close()

    def _serve(self, number: int, bus: Bus, node: Node) -> None:
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


_EXAMPLE = "example: servod-virtual-axis --socket /tmp/vbus0 --plant joint.yaml --record drive.bin --seed 7"
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="servod-virtual-axis", description="A virtual servo axis.", epilog=_EXAMPLE)
    bus = parser.add_mutually_exclusive_group(required=True)
    bus.add_argument("--socket", type=Path, metavar="PATH", help="serve a virtual CAN bus at this Unix socket")
    bus.add_argument("--can", metavar="INTERFACE", help="join a SocketCAN interface, e.g. vcan0")
    parser.add_argument("--plant", type=Path, metavar="FILE", help="axis model of the joint (default: demo joint)")
    parser.add_argument("--settings", type=Path, metavar="FILE", help="settings of the virtual axis (YAML)")
    parser.add_argument("--record", type=Path, metavar="FILE", help="the drive's own record, survives any kill")
    timing = "frames come at once with the bus's time on them (stamped), or when they have really ended (paced)"
    parser.add_argument("--timing", choices=[t.value for t in Timing], default=Timing.STAMPED.value, help=timing)
    scheduler = "SCHED_FIFO priority, below the loop's; 0 leaves the scheduler alone (default: 40)"
    parser.add_argument("--priority", type=int, choices=range(99), metavar="N", default=40, help=scheduler)
    for option, kind in _SETTING_OPTIONS.items():
        parser.add_argument(f"--{option}", type=kind, metavar="N", help=_SETTING_HELP.get(option, _OVERRIDES))
    return parser


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
    arguments = _parser().parse_args(argv)
    try:
        server = _server(arguments)
    except ServodError as error:
        print(f"servod-virtual-axis: {error}", file=sys.stderr)
        return error.exit_code
    on_end_signals(server.stop)
    gc.freeze()  # what stands now stays; collections in the loop then have little to look at
    print(f"ready {arguments.can or arguments.socket}{_take_turns_first(arguments.priority)}", flush=True)
    try:
        server.run()
    finally:
        server.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
