"""The signals that ask a process of servod to end in order. Loop and daemon load it, so it loads little."""

from __future__ import annotations

import signal
from collections.abc import Callable

#: What ends a process from outside: SIGTERM, and SIGHUP where a terminal sends one.
END_SIGNALS = tuple(s for s in signal.Signals if s.name in ("SIGTERM", "SIGHUP"))


def on_end_signals(act: Callable[[], None]) -> None:
    """Let SIGTERM, SIGINT and SIGHUP (its terminal closes) call `act`; under nohup(1), SIGHUP stays ignored."""
    for number in (*END_SIGNALS, signal.SIGINT):
        if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, lambda *_: act())


def restore_inherited_signals() -> None:
    """Take back what the parent left of its own, first of all in a process that has children or deadlines.

    Where SIGCHLD is ignored nobody hears how a child ended, and each seems to have ended well; signals that are blocked
    end nothing. SIGALRM is the loop's own deadline. Nothing to do on Windows.
    """
    if hasattr(signal, "pthread_sigmask"):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, (*END_SIGNALS, signal.SIGINT, signal.SIGALRM))
