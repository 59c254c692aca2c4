"""A motion under a running daemon's recorder, for clients: whatever ends it, the axis is stopped before all else.

Beside servod.client.control. An interrupt may cut a request in the middle, and with it the connection that the client
commands
on; the daemon takes a stop from anybody, so that it goes out on a connection of its own.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from servod.client.control import ControlClient, Refused, Verb
from servod.common.errors import ServodError, Unreachable


def quick_stop(client: ControlClient) -> None:
    """The drive's quick stop, on a connection of its own; a daemon that is gone needs none."""
    with contextlib.suppress(ServodError), ControlClient(client.path) as own:
        own.call(Verb.STOP)


def switch_off(client: ControlClient) -> None:
    """Disable; an axis that is off already needs none. Where this connection is cut, the quick stop does it."""
    try:
        client.call(Verb.DISABLE)
    except Unreachable as error:
        if not isinstance(error, Refused):
            quick_stop(client)
    except ServodError:
        pass


@contextlib.contextmanager
def recording(client: ControlClient) -> Iterator[Path]:
    """The file that the daemon's recorder writes meanwhile; it is whole after the block.

    An interrupt in the block stops the axis before the recorder is asked for anything. Raises as ControlClient.call.
    """
    path = Path(client.call(Verb.RECORD_START)["path"])
    try:
        yield path
    except BaseException as error:
        if not isinstance(error, ServodError):
            quick_stop(client)
        with contextlib.suppress(ServodError):
            client.call(Verb.RECORD_STOP)
        raise
    client.call(Verb.RECORD_STOP)
