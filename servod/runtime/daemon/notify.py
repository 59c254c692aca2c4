"""sd_notify without a library: tells systemd that the daemon is ready, what it does, and that it is alive.

Beside the data path; used by the supervisor alone. Protocol: sd_notify(3), one datagram of NAME=value lines to the
socket named in NOTIFY_SOCKET (a leading "@" stands for the abstract name space).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

from servod.common.units import NS_PER_US


class Notifier:
    """One connection to the service manager; does nothing at all where there is none."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        env = os.environ if environment is None else environment
        self._socket: socket.socket | None = None
        address = env.get("NOTIFY_SOCKET", "")
        if address[:1] in ("/", "@"):
            self._open("\0" + address[1:] if address[0] == "@" else address)
        self.watchdog_ns = _watchdog_ns(env)

    def _open(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        try:
            self._socket.connect(address)
        except OSError:
            self.close()

    def ready(self, status: str) -> None:
        """Start-up is done: READY=1 and a first status line; from now on the watchdog has its own time again."""
        own = f"\nWATCHDOG_USEC={self.watchdog_ns // 1000}\nWATCHDOG=1" if self.watchdog_ns else ""
        self._send(f"READY=1\nSTATUS={_one_line(status)}{own}")

    def restarts(self, status: str, within_s: float) -> None:
        """Nobody feeds the watchdog until the next `ready`, which comes `within_s`."""
        patience = f"\nWATCHDOG_USEC={int(within_s * 1e6)}\nWATCHDOG=1" if self.watchdog_ns else ""
        self._send(f"STATUS={_one_line(status)}{patience}")

    def status(self, status: str) -> None:
        """One line for `systemctl status`."""
        self._send(f"STATUS={_one_line(status)}")

    def waiting(self, status: str, timeout_s: float) -> None:
        """The daemon waits for what is not its own; it says so again within `timeout_s`, before or after `ready`."""
        self._send(f"STATUS={_one_line(status)}\nEXTEND_TIMEOUT_USEC={int(timeout_s * 1e6)}\nWATCHDOG=1")

    def stopping(self, timeout_s: float) -> None:
        """The daemon begins to stop, and needs at most `timeout_s` for it, whatever TimeoutStopSec says."""
        self._send(f"STOPPING=1\nEXTEND_TIMEOUT_USEC={int(timeout_s * 1e6)}")

    def alive(self) -> None:
        """Feed the watchdog; call it only while the loop really advances."""
        self._send("WATCHDOG=1")

    def close(self) -> None:
        """Let go of the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> None:
        if self._socket is None:
            return
        try:
            self._socket.send(message.encode())
        except OSError:
            return  # a manager that does not read must never hold up the supervisor; the watchdog speaks then


def _watchdog_ns(env: Mapping[str, str]) -> int:
    """How often systemd wants to be fed, in ns; 0 when it does not watch this process."""
    if env.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0
    text = env.get("WATCHDOG_USEC", "")
    return int(text) * NS_PER_US if text.isdigit() else 0


def _one_line(text: str) -> str:
    return " ".join(text.split())
