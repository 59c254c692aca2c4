"""What SocketCAN is told: receive filters as the kernel reads them, and time stamps moved to CLOCK_MONOTONIC."""

from __future__ import annotations

import socket
import struct
import threading
import time

import pytest

from servod.runtime.fieldbus.bus.socketcan import _SO_TIMESTAMPNS, SocketCanBus, _monotonic_ns, pack_filters


def accepted(filters: bytes, can_id: int) -> bool:
    """The kernel's rule: received & mask == filter & mask, for any filter (Documentation/networking/can.rst)."""
    rows = struct.iter_unpack("=II", filters)
    return any(can_id & mask == wanted & mask for wanted, mask in rows)


def test_filters_pass_these_identifiers_and_nothing_else() -> None:
    filters = pack_filters((0x181, 0x282))
    assert [can_id for can_id in range(0x800) if accepted(filters, can_id)] == [0x181, 0x282]
    assert not accepted(filters, 0x181 | 0x80000000)  # an extended identifier with the same low bits
    assert not accepted(filters, 0x181 | 0x40000000)  # a remote frame


def stamp(age_ns: int) -> list[tuple[int, int, bytes]]:
    seconds, nanoseconds = divmod(time.time_ns() - age_ns, 1_000_000_000)
    return [(socket.SOL_SOCKET, _SO_TIMESTAMPNS, struct.pack("@ll", seconds, nanoseconds))]


@pytest.mark.parametrize("age_ns", [0, 50_000, 500_000_000])
def test_a_stamp_keeps_its_age(age_ns: int) -> None:
    before_ns = time.monotonic_ns()
    moved_ns = _monotonic_ns(stamp(age_ns))
    assert before_ns - age_ns - 1_000_000 <= moved_ns <= time.monotonic_ns() - age_ns


@pytest.mark.parametrize("age_ns", [-60_000_000_000, 3_600_000_000_000])
def test_a_stamp_from_before_the_clock_was_set_is_replaced(age_ns: int) -> None:
    before_ns = time.monotonic_ns()
    assert before_ns <= _monotonic_ns(stamp(age_ns)) <= time.monotonic_ns()


def test_without_a_stamp_the_local_time_counts() -> None:
    before_ns = time.monotonic_ns()
    assert before_ns <= _monotonic_ns([]) <= time.monotonic_ns()


def test_two_threads_may_wait_for_frames() -> None:
    """The supervisor stops the drive in a thread beside its rounds, and both wait for answers."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus, errors = SocketCanBus(ours), list[BaseException]()

    def wait() -> None:
        try:
            assert bus.receive(0.3) is None
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=wait) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    bus.close()
    theirs.close()
