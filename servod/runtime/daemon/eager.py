"""Coroutines that begin at once, as eager tasks do from Python 3.12 on.

Below connections and requests. What a client asked for is with the loop, and its lease and its trial are noted, before
anything else happens: a client that leaves in the same moment is seen to leave afterwards.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Generator
from typing import Any


def begin(coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None] | None:
    """Run `coroutine` until it waits for the first time; the task of the rest, or None when there is none."""
    try:
        first = coroutine.send(None)
    except StopIteration:
        return None
    return asyncio.get_running_loop().create_task(_Rest(coroutine, first))


class _Rest(Coroutine[Any, Any, None]):
    """A coroutine that waits for `first` already; a task that is cancelled at once cancels it there."""

    def __init__(self, coroutine: Coroutine[Any, Any, None], first: Any) -> None:
        self._coroutine, self._first, self._begun = coroutine, first, False

    def send(self, value: Any) -> Any:
        """Tell the task what is waited for: at first what the coroutine waits for already."""
        if self._begun:
            return self._coroutine.send(value)
        self._begun = True
        return self._first

    def throw(self, *error: Any) -> Any:
        """Raise where the coroutine waits."""
        self._begun = True
        return self._coroutine.throw(*error)

    def close(self) -> None:
        """End the coroutine where it waits."""
        self._coroutine.close()

    def __await__(self) -> Generator[Any, None, None]:
        raise TypeError("this is for a task alone")
