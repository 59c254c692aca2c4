"""Tests whose subject lives on asyncio's event loop."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from typing import Any, ParamSpec

P = ParamSpec("P")


def on_event_loop(test: Callable[P, Coroutine[Any, Any, None]]) -> Callable[P, None]:
    """The test as a plain function, with an event loop of its own; what it leaves under way is cancelled."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        asyncio.run(test(*args, **kwargs))

    return run


async def events_pass() -> None:
    """Let everything on the event loop go on that waits for nothing more."""
    for _ in range(5):  # the door's task begins to wait, the selector tells, it goes on, what it began goes on
        await asyncio.sleep(0)
