"""Requests that take longer than a moment: coroutines on the supervisor's event loop, and what they wait for.

Around the loop. A request is written top to bottom (send the command, wait for the loop's answer, wait for the state);
what it waits for of the axis is looked at once in each round of the supervisor.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine, Generator, Iterable
from concurrent.futures import Future
from typing import Any, TypeVar, cast

from servod.common.errors import ServodError, Unreachable
from servod.common.files import reason
from servod.common.units import NS_PER_S
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.eager import begin
from servod.runtime.loop.commands import REFUSAL_TEXT, Refusal

log = logging.getLogger("servod.control")

T = TypeVar("T")
Request = Coroutine[Any, Any, dict[str, Any]]


async def work_of(future: Future[T]) -> T:
    """What work in another thread gives or raises."""
    return future.result() if future.done() else await asyncio.wrap_future(future)


def taken(record: CycleRecord) -> CycleRecord:
    """The record that answers a command; raises Unreachable with the loop's reason when it was refused."""
    if record.command_result > Refusal.DONE:
        raise Unreachable(f"refused: {REFUSAL_TEXT[Refusal(record.command_result)]}")
    return record


class LoopTimeout(Unreachable):
    """The loop did not answer a command in time: it may carry it out yet."""


class SentOrder:
    """A command to the loop. Awaited, it gives the cycle record that shows it done; raises Unreachable where it was
    refused, LoopTimeout where nobody knows."""

    def __init__(self, seq: int, deadline_ns: int, waits: Waits) -> None:
        self.seq = seq
        self.record: CycleRecord | None = None
        self._deadline_ns, self._waits = deadline_ns, waits

    def over(self, now_ns: int) -> bool:
        """The loop has carried it out or refused it, or does not answer."""
        return self.record is not None or now_ns >= self._deadline_ns

    def __await__(self) -> Generator[Any, None, CycleRecord]:
        yield from self._waits.until(self.over).__await__()
        if self.record is None:
            raise LoopTimeout("the loop did not answer in time")
        return taken(self.record)


class Waits:
    """What requests wait for that comes with a cycle record, or with time."""

    TIMEOUT_NS = 2 * NS_PER_S

    def __init__(self) -> None:
        self._orders: dict[int, SentOrder] = {}
        self._waiting: list[tuple[Callable[[int], bool], asyncio.Future[None]]] = []

    def order(self, seq: int, now_ns: int) -> SentOrder:
        """The command `seq`, which was sent now."""
        self._orders[seq] = order = SentOrder(seq, now_ns + self.TIMEOUT_NS, self)
        return order

    async def until(self, ready: Callable[[int], bool]) -> None:
        """Wait for the round at whose time `ready` is true."""
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((ready, future))
        await future

    def see(self, records: Iterable[CycleRecord], now_ns: int) -> None:
        """A round: look for answers in drained records, and let go on whose wait is over."""
        if self._orders:
            for record in records:
                if order := self._orders.pop(record.command_seq, None):
                    order.record = record
            self._orders = {seq: order for seq, order in self._orders.items() if not order.over(now_ns)}
        for ready, future in self._waiting:
            if not future.done() and ready(now_ns):
                future.set_result(None)
        self._waiting = [(ready, future) for ready, future in self._waiting if not future.done()]


async def answer(request: Request, reply: Reply) -> None:
    """Carry a request out; whatever goes wrong ends the request, never the supervisor."""
    try:
        result = await request
    except ServodError as error:
        reply.failed(error)
    except OSError as error:  # a disk that is full or gone
        reply.failed(Unreachable(f"{error.filename or 'disk'}: {reason(error)}"))
    except Exception as error:  # what nobody foresaw
        log.error("a request failed", exc_info=error)
        reply.failed(error)
    else:
        reply.done(result)


class Requests:
    """All requests under way."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self, request: Request, reply: Reply) -> None:
        """Run `request` until it waits for the first time, and the rest as what it waits for comes."""
        if task := begin(answer(request, reply)):
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


def finish(request: Coroutine[Any, Any, T]) -> T:
    """Run a request to its end where nothing is waited for that has not come: in virtual time."""
    try:
        request.send(None)
    except StopIteration as end:
        return cast(T, end.value)
    request.close()
    raise RuntimeError("a request waits for what does not come in virtual time")
