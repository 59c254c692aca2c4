"""Hears other masters while the nodes are set up, until the loop hears them itself. Off the control path.

What others write meanwhile may stay: it comes behind our own reading back, and no object is read again at once.
"""

from __future__ import annotations

from collections.abc import Callable

from servod.common.errors import Unreachable
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, RPDO_BASE, SYNC_ID, ids_of_masters
from servod.runtime.fieldbus.master.network import BusNetwork


def start_ids(config: AxisConfig) -> tuple[int, ...]:
    """What a StartWatch listens to."""
    nodes = (config.amplifier.node_id, config.encoder.node_id)
    return tuple(sorted(ids_of_masters(nodes, config.heartbeat.master_node_id)))


class StartWatch:
    """A connection of its own for what only a master sends; the NMT commands of `network` are ours."""

    def __init__(self, bus: Bus, network: BusNetwork, config: AxisConfig) -> None:
        """`bus` is opened with `start_ids`; it is closed with `close`."""
        self._bus, self._answers, self._ids = bus, network.answers, frozenset(start_ids(config))
        commands = {base + config.amplifier.node_id for base in RPDO_BASE}
        self._of_loop = commands | {SYNC_ID, HEARTBEAT_BASE + config.heartbeat.master_node_id}
        network.announces.update(self._ids)

    def look(self, loop_began_ns: Callable[[], int | None] = lambda: None) -> None:
        """Take what came; raises Unreachable for what this master did not send.

        `loop_began_ns` is asked behind the last frame. Once the loop has begun, cyclic frames may be its own, and it
        hears those of others itself; whatever came before is nobody's of ours, as far as the frames' stamps tell: an
        adapter without stamps, or one that is a second late, gives the time of reading.
        """
        frames = []
        while (frame := self._bus.receive(0.0)) is not None:
            frames.append(frame)
        began_ns = loop_began_ns() if frames else None
        for frame in frames:
            if began_ns is not None and frame.can_id in self._of_loop and frame.time_ns >= began_ns:
                continue
            if frame.can_id in self._ids and not self._answers.own(frame.can_id, frame.data, heard_late=True):
                raise foreign(f"frame 0x{frame.can_id:03X} {frame.data.hex(' ')}".rstrip())

    def close(self) -> None:
        """The loop hears others from now on."""
        self._bus.close()


def foreign(what: str) -> Unreachable:
    """The start ends: nobody knows what the nodes are set to."""
    return Unreachable(f"somebody else spoke on the bus while the nodes were set up: {what}; see who it is, then start")
