"""Requests that take longer than a moment, as generators: each `yield` names what to wait for, nothing ever blocks.

Around the loop. A flow is written top to bottom (send the command, wait for the loop's answer, wait for the state), and
the supervisor drives all of them once per round of its event loop.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from typing import Any, Protocol

from servod.common.errors import ServodError, Unreachable
from servod.common.files import reason
from servod.common.units import NS_PER_S
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.connection import Reply
from servod.runtime.loop.commands import REFUSAL_TEXT, Refusal

log = logging.getLogger("servod.control")


class Wait(Protocol):
    """Something a flow waits for."""

    def ready(self, now_ns: int) -> bool:
        """Whether it has come, or will not come any more."""
        ...

    def result(self) -> Any:
        """What came; raises ServodError when it went wrong. Called once, after `ready`."""
        ...


Flow = Generator[Wait, Any, dict[str, Any]]


class FutureWait:
    """Work in another thread."""

    def __init__(self, future: Future[Any]) -> None:
        self._future = future

    def ready(self, _now_ns: int) -> bool:
        """The work is done."""
        return self._future.done()

    def result(self) -> Any:
        """What the work gave or raised."""
        return self._future.result()


class OrderWait:
    """A command to the loop: comes back in the cycle record that shows its number."""

    def __init__(self, seq: int, deadline_ns: int) -> None:
        self.seq = seq
        self.record: CycleRecord | None = None
        self._deadline_ns = deadline_ns

    def ready(self, now_ns: int) -> bool:
        """The loop has carried it out or refused it, or does not answer."""
        return self.record is not None or now_ns >= self._deadline_ns

    def result(self) -> CycleRecord:
        """The record that shows it done; raises Unreachable with the loop's reason otherwise."""
        if self.record is None:
            raise Unreachable("the loop did not answer in time")
        refusal = Refusal(self.record.command_result)
        if refusal is not Refusal.DONE:
            raise Unreachable(f"refused: {REFUSAL_TEXT[refusal]}")
        return self.record


class StateWait:
    """A state of the axis; gives the newest record, also when time is up."""

    def __init__(
        self,
        latest: Callable[[], CycleRecord | None],
        reached: Callable[[CycleRecord], bool],
        deadline_ns: int,
    ) -> None:
        self._latest, self._reached, self._deadline_ns = latest, reached, deadline_ns

    def ready(self, now_ns: int) -> bool:
        """Reached, or out of time."""
        record = self._latest()
        return now_ns >= self._deadline_ns or (record is not None and self._reached(record))

    def result(self) -> CycleRecord:
        """The newest record; raises Unreachable when there is none at all."""
        record = self._latest()
        if record is None:
            raise Unreachable("the loop has not begun")
        return record


class OrderSender:
    """Commands on their way to the loop, by number."""

    TIMEOUT_NS = 2 * NS_PER_S

    def __init__(self) -> None:
        self._pending: dict[int, OrderWait] = {}

    def expect(self, seq: int, now_ns: int) -> OrderWait:
        """Wait for the command `seq`."""
        wait = OrderWait(seq, now_ns + self.TIMEOUT_NS)
        self._pending[seq] = wait
        return wait

    def see(self, records: Iterable[CycleRecord], now_ns: int) -> None:
        """Look for answers in drained records, and forget commands that got none."""
        if not self._pending:
            return
        for record in records:
            if wait := self._pending.pop(record.command_seq, None):
                wait.record = record
        self._pending = {seq: w for seq, w in self._pending.items() if not w.ready(now_ns)}


class Flows:
    """All flows under way."""

    def __init__(self) -> None:
        self._running: list[tuple[Flow, Wait, Reply]] = []

    def start(self, flow: Flow, reply: Reply) -> None:
        """Run `flow` until it waits for the first time."""
        self._advance(flow, None, reply)

    def poll(self, now_ns: int) -> None:
        """Go on with every flow whose wait is over."""
        running, self._running = self._running, []
        for flow, wait, reply in running:
            if wait.ready(now_ns):
                self._advance(flow, wait, reply)
            else:
                self._running.append((flow, wait, reply))

    def _advance(self, flow: Flow, wait: Wait | None, reply: Reply) -> None:
        try:
            self._running.append((flow, _step(flow, wait), reply))
        except StopIteration as end:
            reply.done(end.value)
        except ServodError as error:
            reply.failed(error)
        except OSError as error:  # a disk that is full or gone ends the request, never the supervisor
            reply.failed(Unreachable(f"{error.filename or 'disk'}: {reason(error)}"))
        except Exception as error:  # and so does what nobody foresaw
            log.error("a request failed", exc_info=error)
            reply.failed(error)


def _step(flow: Flow, wait: Wait | None) -> Wait:
    """Give the flow what it waited for, or raise there what went wrong; returns what it waits for next."""
    if wait is None:
        return next(flow)
    try:
        value = wait.result()
    except Exception as error:
        return flow.throw(error)
    return flow.send(value)


def finish(flow: Flow) -> dict[str, Any]:
    """Run a flow to its end where nothing is waited for that has not come: in virtual time, and in tests."""
    wait: Wait | None = None
    while True:
        try:
            wait = _step(flow, wait)
        except StopIteration as end:
            return dict(end.value)
