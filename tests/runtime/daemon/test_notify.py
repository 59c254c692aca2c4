import os
import socket
from pathlib import Path

import pytest

from servod.runtime.daemon.notify import Notifier


@pytest.fixture
def manager(tmp_path: Path) -> socket.socket:
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.settimeout(2)
    manager.bind(str(tmp_path / "notify"))
    return manager


def test_messages_are_what_systemd_reads(manager: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname()})
    notifier.ready("all\nwell")
    notifier.alive()
    notifier.status("ENABLED")
    notifier.stopping(2.5)
    assert [manager.recv(200) for _ in range(4)] == [
        b"READY=1\nSTATUS=all well",
        b"WATCHDOG=1",
        b"STATUS=ENABLED",
        b"STOPPING=1\nEXTEND_TIMEOUT_USEC=2500000",
    ]
    notifier.close()
    manager.close()


def test_who_begins_anew_has_the_watchdogs_patience_until_it_is_ready_again(manager: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname(), "WATCHDOG_USEC": "2000000"})
    notifier.restarts("bus and nodes are back", 60.0)
    notifier.ready("the axis is disabled")
    assert [manager.recv(200) for _ in range(2)] == [
        b"STATUS=bus and nodes are back\nWATCHDOG_USEC=60000000\nWATCHDOG=1",
        b"READY=1\nSTATUS=the axis is disabled\nWATCHDOG_USEC=2000000\nWATCHDOG=1",
    ]


def test_abstract_address() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(2)
        manager.bind("\0servod-test-notify")
        Notifier({"NOTIFY_SOCKET": "@servod-test-notify"}).alive()
        assert manager.recv(100) == b"WATCHDOG=1"


@pytest.mark.parametrize("address", ["", "/nowhere/at/all", "relative"])
def test_without_a_manager_nothing_happens(address: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": address})
    notifier.ready("x")
    notifier.alive()
    assert notifier.watchdog_ns == 0


def test_manager_that_does_not_read_never_blocks(manager: socket.socket) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.getsockname()})
    for _ in range(10_000):
        notifier.status("x" * 100)
    assert manager.recv(200).startswith(b"STATUS=x")
    manager.close()


def test_watchdog_is_for_this_process_only() -> None:
    assert Notifier({"WATCHDOG_USEC": "2000000"}).watchdog_ns == 2_000_000_000
    assert Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}).watchdog_ns == 2_000_000_000
    assert Notifier({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}).watchdog_ns == 0
    assert Notifier({"WATCHDOG_USEC": "soon"}).watchdog_ns == 0
