"""Independent witness for the master: canopen's own LocalNode as the device, on python-can's virtual bus.

It knows nothing of servod: SDO server, NMT slave and heartbeat are canopen's, its dictionary is the shipped EDS.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import canopen

from servod import drivers
from servod.common.clock import WallClock
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.bus.python_can import PythonCanBus
from servod.runtime.fieldbus.master import Master
from tests.axis_limits import LIMITS

EDS = Path(drivers.__file__).parent / "eds"


def axis_config(**sections: Any) -> AxisConfig:
    """A configuration that fits the shipped EDS files; sections are merged over the defaults."""
    return AxisConfig.model_validate({"limits": LIMITS, "gains": {"initial": "gains.yaml"}} | sections)


class Witness:
    """Two local nodes on a channel of their own."""

    def __init__(self) -> None:
        self.channel = uuid.uuid4().hex
        self.network = canopen.Network(can.Bus(interface="virtual", channel=self.channel))
        self.network.NOTIFIER_CYCLE = 0.05
        self.network.connect()
        self.amplifier = self.network.create_node(1, str(EDS / "amplifier.eds"))
        self.encoder = self.network.create_node(2, str(EDS / "encoder.eds"))
        self.amplifier.sdo[0x6041].raw = 0x0250  # switch on disabled, remote, voltage
        self.boot()

    def boot(self) -> None:
        """Both nodes announce themselves and go pre-operational."""
        for node in (self.amplifier, self.encoder):
            node.nmt.state = "INITIALISING"
            node.nmt.state = "PRE-OPERATIONAL"

    def bus(self) -> PythonCanBus:
        """Another connection to the channel."""
        return PythonCanBus(can.Bus(interface="virtual", channel=self.channel), kernel_errors=False)

    def raw(self) -> can.BusABC:
        """A bare python-can connection, to send what no device should."""
        return can.Bus(interface="virtual", channel=self.channel)


@contextmanager
def witness() -> Iterator[Witness]:
    """A witness for one test."""
    world = Witness()
    try:
        yield world
    finally:
        for node in (world.amplifier, world.encoder):
            node.nmt.stop_heartbeat()
        world.network.disconnect()


@contextmanager
def master(world: Witness, config: AxisConfig, threaded: bool = True) -> Iterator[Master]:
    """A master on the witness's channel."""
    instance = Master(config, world.bus(), WallClock(), threaded)
    try:
        yield instance
    finally:
        instance.close()
