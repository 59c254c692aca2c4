"""Waits for bus and nodes: at the start until they are there, after their loss until the axis may begin again.

Around the loop, for a daemon that runs with `--wait`, as the service does. Whether they are there is looked at by reads
alone on a connection of its own (servod.runtime.fieldbus.master, `Master.look`). A restart ends DISABLED: it is a
new bring-up, as after a restart of the daemon, and enables nothing; what else was wrong before it stays latched.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future
from contextlib import closing
from typing import Any, NamedTuple

from servod.common.clock import WallClock
from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.faults import FAULTS, FaultCode, Reaction
from servod.common.units import NS_PER_S
from servod.formats.config import AxisConfig
from servod.formats.protocol import Verb
from servod.formats.recording.incidents import Incident
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.control_server import ControlServer
from servod.runtime.daemon.notify import Notifier
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.cia import HEARTBEAT_BASE, SDO_ANSWER_BASE
from servod.runtime.fieldbus.master import Master
from servod.runtime.loop.axis_state import AxisState

log = logging.getLogger("servod")

_ROUND_S = 0.02
_LOOK_EVERY_S, _NOTIFY_EVERY_S = 1.0, 1.0
#: Between two attempts to bring up nodes that answer, at the longest.
_LONGEST_PAUSE_S = 30.0
#: A fault is shown for so long before the axis begins again; one that comes back at once for twice as long each time.
SHOWN_S, _LONGEST_SHOWN_S = 2.0, 60.0
#: What the log says when an axis begins again.
STARTS_AGAIN = "bus and nodes are back: bringing the axis up again, disabled"
#: An axis that ran for so long did begin; what takes it away then is another matter.
_RAN_S = 60.0
#: What takes bus or nodes away, by whatever is plugged, supplied or configured outside of servod.
_TAKEN = sum(
    FAULTS[code].bit
    for code in (FaultCode.BUS_DOWN, FaultCode.BUS_OFF, FaultCode.NODE_HEARTBEAT_LOST, FaultCode.DRIVE_RESET)
)
#: Faults that stop nothing.
_SMALL = sum(fault.bit for fault in FAULTS.values() if fault.reaction <= Reaction.CLIP)
#: What such a loss brings with it, and the new bring-up mends; every other fault is a person's to acknowledge.
_OF_THE_LOSS = (
    _TAKEN
    + _SMALL
    + sum(
        FAULTS[code].bit
        for code in (
            FaultCode.FEEDBACK_STALE,
            FaultCode.ENCODER_ALARM,  # its alarm word came no more
            FaultCode.DRIVE_LEFT_OPERATION,
            FaultCode.DRIVE_MODE_WRONG,
            FaultCode.DRIVE_STAYS_POWERED,
            FaultCode.COMMANDS_LOST,
            FaultCode.NODE_LEFT_OPERATIONAL,
        )
    )
)


def look(config: AxisConfig, of_ours: Callable[[Bus], Bus] | None = None) -> None:
    """See that both nodes are there and may be brought up. Raises ServodError with what is in the way.

    `of_ours` makes the connection known to a master that still watches the nodes.
    """
    ids = tuple(base + n.node_id for n in (config.amplifier, config.encoder) for base in _LISTENED)
    bus = open_bus(config.bus, ids)
    with closing(Master(config, of_ours(bus) if of_ours else bus, WallClock(), threaded=False)) as master:
        master.look()


_LISTENED = (SDO_ANSWER_BASE, HEARTBEAT_BASE)


def wait_for_nodes(
    config: AxisConfig, notifier: Notifier, incidents: Iterable[Incident], failure: BringUpFailure | None = None
) -> None:
    """Return once `look` finds nothing in the way; until then the control socket and the manager are told what is.

    `incidents` is what befell the axis before, for who asks; after the `failure` of a bring-up it is looked later.
    Raises BadInput, which no waiting mends.
    """
    if failure is None:
        try:
            look(config)
        except BadInput:
            raise
        except ServodError as error:
            failure = BringUpFailure(str(error), _LOOK_EVERY_S)
    if failure is not None:
        asyncio.run(_Waiting(config, notifier, incidents).wait(*failure))


class BringUpFailure(NamedTuple):
    """Nodes that answer and could not be brought up all the same: why, and how long to wait before the next look."""

    why: str
    pause_s: float

    @classmethod
    def after(cls, error: ServodError, earlier: BringUpFailure | None) -> BringUpFailure:
        """One more: each bring-up writes to the nodes, so that the next one comes later."""
        return cls(str(error), min(_LONGEST_PAUSE_S, 2.0 * earlier.pause_s) if earlier else _LOOK_EVERY_S)


class _Waiting:
    """Control socket and manager of a daemon that has no axis yet."""

    def __init__(self, config: AxisConfig, notifier: Notifier, incidents: Iterable[Incident]) -> None:
        self._config, self._notifier, self._incidents = config, notifier, incidents
        self._since, self._notify_at, self._why = time.monotonic(), 0.0, ""

    async def wait(self, why: str, pause_s: float) -> None:
        """Look again and again, for `why` at first and after `pause_s`."""
        self._note(why)
        server = ControlServer(self._config.control, self)
        server.begin()
        try:
            while not await self._look(server, pause_s):
                pause_s = _LOOK_EVERY_S
        finally:
            server.close("servod begins, for bus and nodes are there")

    async def _look(self, server: ControlServer, pause_s: float) -> bool:
        """One look after a pause, in a thread of its own, while clients are served."""
        now = time.monotonic()
        pause_over, attempt = now + pause_s, None
        while attempt is None or not attempt.done():
            server.tick(time.monotonic_ns())
            self._notify(now)
            await asyncio.sleep(_ROUND_S)
            now = time.monotonic()
            if attempt is None and now >= pause_over:
                attempt = asyncio.get_running_loop().run_in_executor(None, look, self._config)
        error = attempt.exception()
        if error is None:
            return True
        if isinstance(error, BadInput) or not isinstance(error, ServodError):
            raise error
        self._note(str(error))
        return False

    def _note(self, why: str) -> None:
        if why != self._why:
            log.warning("waiting for bus and nodes: %s", why)
        self._why = why

    def _notify(self, now: float) -> None:
        if now >= self._notify_at:
            self._notify_at = now + _NOTIFY_EVERY_S
            self._notifier.waiting(self._state(), 10.0 * _NOTIFY_EVERY_S)

    def _state(self) -> str:
        return f"waits for bus and nodes, {time.monotonic() - self._since:.0f} s so far: {self._why}"

    def handle(self, verb: Verb, _args: dict[str, Any], reply: Reply) -> None:
        """What befell the axis; nothing else can be had. Raises Unreachable with the state."""
        if verb is not Verb.FAULTS:
            raise Unreachable(f"servod {self._state()}; it begins by itself once they answer")
        directory = str(self._config.recorder.directory.resolve())
        incidents = [incident.document() for incident in self._incidents]
        reply.done({"name": self._config.name, "directory": directory, "incidents": incidents})

    def status(self) -> dict[str, Any]:
        """For those who watch. Raises Unreachable with the state."""
        raise Unreachable(f"servod {self._state()}")

    def motion_running(self) -> bool:
        """None does."""
        return False

    def lease_ended(self) -> None:
        """Nothing was begun."""

    renew_ns = None

    def abandon_motion(self, why: str) -> None:
        """There is none."""


class Comeback:
    """Whether an axis that lost bus or nodes may begin again: it stands, its fault was shown, and both are back."""

    def __init__(
        self,
        config: AxisConfig,
        worker: Executor,
        of_ours: Callable[[Bus], Bus],
        shown_s: float = SHOWN_S,
        carried: int = 0,
    ) -> None:
        """`worker` looks, so that the supervisor waits for nobody; `of_ours`: as `look` has it. The faults `carried`
        were latched before this axis began, and are not of its next loss."""
        self._config, self._worker, self._shown_ns = config, worker, round(shown_s * NS_PER_S)
        self._of_ours = of_ours
        self._lost_ns: int | None = None
        self._look_ns = 0
        #: Faults that were latched a second and more before the loss, and those of the last look at the second's end.
        self.before, self._newer, self._second_ns = carried, carried, 0
        self._attempt: Future[None] | None = None

    def see(self, record: CycleRecord | None, now_ns: int) -> bool:
        """Once per round, with the newest record; True: begin again."""
        lost = record is not None and (record.faults | record.faults_latched) & _TAKEN
        if record is not None and not lost and now_ns - self._second_ns >= NS_PER_S:
            self.before, self._newer, self._second_ns = self._newer, record.faults_latched, now_ns
        if record is None or not lost or not AxisState(record.axis_state).stopped:
            self._lost_ns = self._attempt = None
            return False
        if self._lost_ns is None:
            self._lost_ns = self._look_ns = now_ns
        if self._attempt is not None and self._attempt.done():
            there = not self._attempt.cancelled() and self._attempt.exception() is None
            self._attempt = None
            return there
        if self._attempt is None and now_ns >= max(self._lost_ns + self._shown_ns, self._look_ns):
            self._look_ns = now_ns + round(_LOOK_EVERY_S * NS_PER_S)
            self._attempt = self._worker.submit(look, self._config, self._of_ours)
        return False


def carried_by(faults: int, before: int) -> int:
    """Of the latched `faults`, as bits, what stays latched when the axis begins again, until somebody resets it; what
    was latched `before` the loss is not of it."""
    return faults & ~(_OF_THE_LOSS & ~(before & ~_SMALL))


def shown_s_after(shown_s: float, ran_s: float) -> float:
    """How long the next fault is shown, when the axis ran for `ran_s` until it began again."""
    return SHOWN_S if ran_s >= _RAN_S + shown_s else min(_LONGEST_SHOWN_S, 2.0 * shown_s)
