"""SDO access alone: time-out with an abort on the wire, late answers, lengths, one transfer at a time."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import can
import pytest
from witness import EDS, Witness, witness

from servod.common.clock import WallClock
from servod.common.errors import BadInput, Unreachable
from servod.common.units import NS_PER_S
from servod.runtime.fieldbus.devices import SdoAbort
from servod.runtime.fieldbus.master.eds import load_dictionary
from servod.runtime.fieldbus.master.network import AnnouncedBus, BusNetwork, SdoAnswers
from servod.runtime.fieldbus.master.sdo import SDO_TIMEOUT_S, NodeSdo, abort_text


@pytest.fixture
def world() -> Iterator[Witness]:
    with witness() as instance:
        yield instance


@pytest.fixture(params=[True, False], ids=["threaded", "pumped"])
def network(world: Witness, request: pytest.FixtureRequest) -> Iterator[BusNetwork]:
    instance = BusNetwork(world.bus(), WallClock(), request.param)
    yield instance
    instance.disconnect()


def access(network: BusNetwork, node_id: int = 1) -> NodeSdo:
    return NodeSdo(network, node_id, load_dictionary(EDS / "amplifier.eds", node_id).objects)


def test_signed_and_unsigned_values_come_back(network: BusNetwork) -> None:
    sdo = access(network)
    for index, value in ((0x6060, -3), (0x607C, -(2**31)), (0x1017, 65535), (0x6085, 2**32 - 1)):
        sdo.write(index, 0, value)
        assert sdo.read(index) == value


def test_strings_come_segmented(network: BusNetwork, world: Witness) -> None:
    assert access(network).read_text(0x1008) == world.amplifier.sdo[0x1008].raw
    assert len(world.amplifier.sdo[0x1008].raw) > 4


def test_a_time_out_is_told_to_the_node_by_an_abort(network: BusNetwork, world: Witness) -> None:
    listener = world.raw()
    started = time.monotonic()
    with pytest.raises(Unreachable, match=r"node 5 object 0x6041:0: read failed, No SDO response"):
        access(network, 5).read(0x6041)
    assert SDO_TIMEOUT_S <= time.monotonic() - started < 3 * SDO_TIMEOUT_S
    frames = [message for message in iter(lambda: listener.recv(0.05), None) if message.arbitration_id == 0x605]
    assert bytes(frames[-1].data) == struct.pack("<BHBL", 0x80, 0x6041, 0, 0x05040000)
    listener.shutdown()


def answer_late(bus: can.BusABC, stop: threading.Event) -> None:
    """A node that answers the first request only after the client gave up, then answers at once."""
    first = True
    while not stop.is_set():
        message = bus.recv(0.05)
        if message is None or message.arbitration_id != 0x605 or message.data[0] != 0x40:
            continue
        if first:
            time.sleep(1.3 * SDO_TIMEOUT_S)
        value = 111 if first else 222
        first = False
        data = struct.pack("<BHBL", 0x43, 0x6076, 0, value)
        bus.send(can.Message(arbitration_id=0x585, data=data, is_extended_id=False))


def test_an_answer_that_came_too_late_is_not_taken_for_the_next(network: BusNetwork, world: Witness) -> None:
    stop, bus = threading.Event(), world.raw()
    slow = threading.Thread(target=answer_late, args=(bus, stop))
    slow.start()
    try:
        sdo = access(network, 5)
        with pytest.raises(Unreachable):
            sdo.read(0x6076)
        time.sleep(SDO_TIMEOUT_S)
        assert sdo.read(0x6076) == 222
    finally:
        stop.set()
        slow.join()
        bus.shutdown()


@pytest.mark.parametrize("stale", [b"\x4b\x41\x60\x00\x50\x02\0\0", b"\x60\x85\x60\x00\0\0\0\0"])
def test_an_answer_that_names_another_object_is_not_taken_for_this_one(
    stale: bytes, network: BusNetwork, world: Witness
) -> None:
    """The question was another client's, or one of ours that nobody waits for any more."""
    bus, answers = world.raw(), [stale, struct.pack("<BHBL", 0x43, 0x6076, 0, 222)]

    def answer() -> None:
        while (message := bus.recv(1.0)) is not None and message.arbitration_id != 0x605:
            continue
        for data in answers:
            bus.send(can.Message(arbitration_id=0x585, data=data, is_extended_id=False))

    node = threading.Thread(target=answer)
    node.start()
    try:
        assert access(network, 5).read(0x6076) == 222
    finally:
        node.join()
        bus.shutdown()


@pytest.mark.parametrize(
    "command",
    [0x4B, 0x42, 0x43],
    ids=["two bytes", "no size told", "filled up to four"],
)
def test_a_question_is_answered_by_what_a_read_takes(command: int, network: BusNetwork, world: Witness) -> None:
    """0x6072 has two bytes. CiA 301 allows an answer without its size, and drives are known that send four."""
    bus, sdo = world.raw(), access(network, 5)

    def answer() -> None:
        while (message := bus.recv(1.0)) is not None and message.arbitration_id != 0x605:
            continue
        data = struct.pack("<BHBHH", command, 0x6072, 0, 1000, 0x7777)
        bus.send(can.Message(arbitration_id=0x585, data=data, is_extended_id=False))

    node = threading.Thread(target=answer)
    node.start()
    try:
        assert sdo.ask(0x6072, 0)
        assert network.wait(lambda: sdo.answer() is not None, SDO_TIMEOUT_S)
        assert sdo.answer() == (1000, 0)
    finally:
        node.join()
        bus.shutdown()


def test_a_request_that_the_bus_did_not_take_is_not_owed_to_a_stranger(world: Witness) -> None:
    network = BusNetwork(world.bus(), WallClock(), False)
    access(network)
    network.subscribe(0x601, lambda *_: None)
    bus = world.bus()
    bus.send = lambda can_id, data: False  # type: ignore[method-assign]
    assert not AnnouncedBus(bus, network).send(0x601, b"\x40\x41\x60\0\0\0\0\0")
    assert not network.answers.own(0x601, b"\x40\x41\x60\0\0\0\0\0")
    network.disconnect()


def test_nothing_is_asked_beside_a_further_connection_of_this_process(network: BusNetwork, world: Witness) -> None:
    """A server knows one transfer: a question would break a string that the other connection reads in segments."""
    sdo, beside = access(network), AnnouncedBus(world.bus(), network)
    assert not sdo.ask(0x6041, 0)
    beside.close()
    assert sdo.ask(0x6041, 0)
    assert network.wait(lambda: sdo.answer() is not None, SDO_TIMEOUT_S)


def test_a_value_that_does_not_fit_never_goes_out(network: BusNetwork) -> None:
    with pytest.raises(BadInput, match="found 256; allowed: a value of 8 bits"):
        access(network).write(0x60C2, 1, 256)


def test_an_object_that_the_eds_lacks_is_as_absent_as_the_device_says(network: BusNetwork) -> None:
    with pytest.raises(SdoAbort, match="the EDS has no such object") as abort:
        access(network).write(0x5FFF, 0, 1)
    assert abort.value.code == 0x06020000


def test_two_threads_on_one_node_never_mix_answers(world: Witness) -> None:
    network = BusNetwork(world.bus(), WallClock(), threaded=True)
    sdo = access(network)
    sdo.write(0x6080, 0, 11)
    sdo.write(0x6085, 0, 22)
    seen: dict[int, set[int]] = {0x6080: set(), 0x6085: set()}

    def read_many(index: int) -> None:
        for _ in range(40):
            seen[index].add(sdo.read(index))

    threads = [threading.Thread(target=read_many, args=(index,)) for index in seen]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    network.disconnect()
    assert seen == {0x6080: {11}, 0x6085: {22}}


@pytest.mark.parametrize(
    ("code", "text"), [(0x06070010, "length"), (0x05040000, "time out"), (0x12345678, "unknown abort code")]
)
def test_every_abort_code_has_words(code: int, text: str) -> None:
    assert text in abort_text(code)


def test_a_bus_that_takes_no_frame_is_unreachable(network: BusNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise can.CanOperationError("queue full")

    monkeypatch.setattr(network._servod_bus._bus, "send", refuse)  # type: ignore[attr-defined]
    with pytest.raises(Unreachable, match=r"frame 0x601 could not be sent \(full queue\)"):
        access(network).read(0x1000)


class HandClock(WallClock):
    """Moved on by hand."""

    ns = 0

    def now_ns(self) -> int:
        return self.ns


def test_a_frame_that_was_announced_and_never_came_excuses_no_other_for_long() -> None:
    clock = HandClock()
    answers, request = SdoAnswers(clock), (0x601, bytes(8))
    answers.announce(*request)
    clock.ns += 4 * NS_PER_S
    assert answers.own(*request) and not answers.own(*request)
    for heard_late in (False, True):
        answers.announce(*request)
        clock.ns += 6 * NS_PER_S
        assert answers.own(*request, heard_late=heard_late) is heard_late
    answers.announce(*request)
    answers.withdraw(*request)
    assert not answers.own(*request)
