"""One participant's CAN controller: transmit queue, error counters, error states (ISO 11898-1, fault confinement).

Stands between the hub and whoever takes part: a node, a socket client, an in-process connection.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import IntEnum

PASSIVE_LIMIT = 127
BUS_OFF_LIMIT = 255


class ErrorState(IntEnum):
    """Fault confinement states, and the two moments that are worth telling."""

    ACTIVE = 0
    PASSIVE = 1
    BUS_OFF = 2


Receiver = Callable[[int, bytes, int], None]
StateListener = Callable[[ErrorState, int], None]
LinkListener = Callable[[bool, int], None]


class Port:
    """A CAN controller on the hub. It counts what befell it: `sent` frames that the bus carried, `silenced` frames that
    it neither sent nor heard while silent, `held` frames that had to wait, `bus_offs`, and `downs` of its interface.

    `receive(can_id, data, time_ns)` gets every frame of the others at the moment the frame ended;
    `on_state(state, time_ns)` hears of error passive, bus-off and of the return to error active, `on_link(up, time_ns)`
    of the interface that goes down and comes back."""

    __slots__ = (
        "bus_offs",
        "delay_ns",
        "depth",
        "downs",
        "dropped",
        "held",
        "name",
        "on_link",
        "on_state",
        "queue",
        "receive",
        "receive_errors",
        "restart_ns",
        "sent",
        "silenced",
        "silent_until_ns",
        "state",
        "stuck_until_ns",
        "transmit_errors",
    )

    def __init__(self, name: str, receive: Receiver, depth: int = 64, restart_ns: int = 0) -> None:
        self.name, self.receive, self.depth = name, receive, depth
        self.restart_ns = restart_ns  # from bus-off back to error active; 0: never by itself
        self.on_state: StateListener = ignore_state
        self.on_link: LinkListener = ignore_link
        self.queue: deque[tuple[int, bytes, int]] = deque()
        self.dropped = 0
        self.transmit_errors = 0
        self.receive_errors = 0
        self.state = ErrorState.ACTIVE
        self.silent_until_ns = 0  # neither sends nor hears
        self.stuck_until_ns = 0  # what is sent waits
        self.delay_ns = 0
        self.sent = self.silenced = self.held = self.bus_offs = self.downs = 0

    def count(self, transmit: int, receive: int, time_ns: int) -> bool:
        """Add to the error counters and follow the states; True when this led to bus-off."""
        self.transmit_errors = max(self.transmit_errors + transmit, 0)
        self.receive_errors = min(max(self.receive_errors + receive, 0), BUS_OFF_LIMIT)
        if self.transmit_errors > BUS_OFF_LIMIT:
            new = ErrorState.BUS_OFF
        elif max(self.transmit_errors, self.receive_errors) > PASSIVE_LIMIT:
            new = ErrorState.PASSIVE
        else:
            new = ErrorState.ACTIVE
        changed, self.state = new != self.state, new
        if not changed:
            return False
        self.bus_offs += new is ErrorState.BUS_OFF
        self.on_state(new, time_ns)
        return new is ErrorState.BUS_OFF

    def restart(self, time_ns: int) -> None:
        """Return from bus-off with clear counters (128 times 11 recessive bits are taken as passed)."""
        self.transmit_errors = self.receive_errors = 0
        self.state = ErrorState.ACTIVE
        self.on_state(ErrorState.ACTIVE, time_ns)


def ignore_state(state: ErrorState, time_ns: int) -> None:
    """State listener of a port whose owner does not care."""


def ignore_link(up: bool, time_ns: int) -> None:
    """Link listener of a port that has no interface."""
