"""The signals that ask a process of servod to end in order. Ground floor."""

from __future__ import annotations

import signal
from collections.abc import Callable


def on_end_signals(act: Callable[[], None]) -> None:
    """Let SIGTERM, SIGINT and SIGHUP (its terminal closes) call `act`; under nohup(1), SIGHUP stays ignored."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: act())
