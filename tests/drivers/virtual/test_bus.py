"""The virtual bus: arbitration, bit time and the cycle's budget; queues, error counters, bus-off, faults on demand."""

from __future__ import annotations

import pytest

from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.hub import Hub, arbitration_key, frame_bits
from servod.drivers.virtual.port import ErrorState, Port
from servod.drivers.virtual.timeline import Timeline
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG
from tests.drivers.virtual.bench import Bench


class Wire:
    """A hub with three participants that note what they hear."""

    def __init__(self, bit_rate: int = 1_000_000, depth: int = 10) -> None:
        self.timeline = Timeline()
        self.hub = Hub(self.timeline, bit_rate)
        self.heard: list[tuple[str, int, int]] = []
        self.ports = [self.hub.attach(Port(name, self._listener(name), depth)) for name in "abc"]

    def _listener(self, name: str):  # type: ignore[no-untyped-def]
        return lambda can_id, data, time_ns: self.heard.append((name, can_id, time_ns))

    def run(self, until_ns: int) -> None:
        while self.hub.step(until_ns):
            pass

    def order(self) -> list[int]:
        """Identifiers in the order in which c heard them."""
        return [can_id for name, can_id, _ in self.heard if name == "c"]


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (4, 95), (8, 135)])
def test_worst_case_lengths_of_the_budget(length: int, bits: int) -> None:
    assert frame_bits(0x181, length) == bits


def test_one_cycle_costs_what_the_budget_says() -> None:
    bench = Bench()
    bench.operational()
    before = bench.world.hub.busy_ns
    bench.cycle(0x06, cycles=10)
    extra = sum(frame.can_id in (0x281, 0x182) for frame in bench.heard[-40:])
    assert 3_800_000 <= bench.world.hub.busy_ns - before <= 3_800_000 + extra * 100_000


@pytest.mark.parametrize("bit_rate", [125_000, 500_000, 1_000_000])
def test_a_frame_arrives_after_its_bit_time(bit_rate: int) -> None:
    wire = Wire(bit_rate)
    wire.hub.submit(wire.ports[0], 0x181, bytes(8), 1000)
    wire.run(10_000_000)
    assert wire.heard == [(name, 0x181, 1000 + 135 * 1_000_000_000 // bit_rate) for name in "bc"]


def test_the_lowest_identifier_wins_and_the_loser_follows() -> None:
    wire = Wire()
    a, b, _ = wire.ports
    wire.hub.submit(a, 0x300, b"", 0)
    wire.hub.submit(b, 0x100, b"", 0)
    wire.hub.submit(a, 0x050, b"", 0)  # behind 0x300 in a's queue
    wire.hub.submit(b, 0x200, b"", 0)
    wire.run(1_000_000)
    assert wire.order() == [0x100, 0x200, 0x300, 0x050]


def test_a_running_frame_is_not_interrupted() -> None:
    wire = Wire()
    wire.hub.submit(wire.ports[0], 0x700, bytes(8), 0)
    wire.run(10_000)
    wire.hub.submit(wire.ports[1], 0x001, b"", 10_000)
    wire.run(1_000_000)
    assert wire.order() == [0x700, 0x001]


def test_order_of_formats_in_arbitration() -> None:
    standard, remote = 0x123, 0x123 | CAN_RTR_FLAG
    extended = 0x123 << 18 | CAN_EFF_FLAG
    keys = [arbitration_key(i) for i in (standard, remote, extended, 0x124)]
    assert keys == sorted(keys)
    assert len(set(keys)) == 4


def test_a_full_queue_refuses() -> None:
    wire = Wire(depth=2)
    taken = [wire.hub.submit(wire.ports[0], 0x100, b"", 0) for _ in range(3)]
    assert taken == [True, True, False]
    assert wire.ports[0].dropped == 1


def test_corrupt_frames_are_repeated_and_counted() -> None:
    wire = Wire()
    wire.hub.faults.arm(FaultKind.CORRUPT, 0x100, 3)
    wire.hub.submit(wire.ports[0], 0x100, b"", 0)
    wire.run(1_000_000)
    assert wire.order() == [0x100]
    assert wire.ports[0].transmit_errors == 3 * 8 - 1
    assert wire.ports[1].receive_errors == 3 - 1


def test_error_passive_then_bus_off_then_restart() -> None:
    wire = Wire()
    states: list[ErrorState] = []
    sender = wire.ports[0]
    sender.on_state = lambda state, time_ns: states.append(state)
    sender.restart_ns = 1_000_000
    wire.hub.faults.arm(FaultKind.CORRUPT, 0x100, 32)
    wire.hub.submit(sender, 0x100, b"", 0)
    wire.run(10_000_000)
    assert states == [ErrorState.PASSIVE, ErrorState.BUS_OFF]
    assert not wire.hub.submit(sender, 0x100, b"", 10_000_000)
    wire.timeline.fire_next()
    assert states[-1] is ErrorState.ACTIVE
    assert wire.hub.submit(sender, 0x100, b"", 20_000_000)
    wire.run(30_000_000)
    assert wire.order() == [0x100]


def test_dropped_frames_reach_nobody() -> None:
    wire = Wire()
    wire.hub.faults.arm(FaultKind.DROP, 0x100, 1)
    for _ in range(2):
        wire.hub.submit(wire.ports[0], 0x100, b"", 0)
    wire.run(1_000_000)
    assert wire.order() == [0x100]
    assert wire.hub.frames == 2


def test_a_client_sees_its_own_bus_off(bench: Bench) -> None:
    bench.bus.inject(BusFault(FaultKind.BUS_OFF))
    assert bench.bus.counters.bus_off
    assert not bench.bus.send(0x80, b"")
    assert bench.bus.counters.queue_full == 0


def test_a_full_queue_is_counted_at_the_client() -> None:
    bench = Bench(queue_depth=5)
    assert [bench.bus.send(0x300, b"") for _ in range(6)] == [True] * 5 + [False]
    assert bench.bus.counters.queue_full == 1


def test_delay_of_a_participant(bench: Bench) -> None:
    bench.operational()
    bench.bus.inject(BusFault(FaultKind.DELAY, amount=300, participant=2))
    bench.heard.clear()
    bench.cycle(cycles=1)
    times = {frame.can_id: frame.time_ns for frame in bench.heard}
    assert times[0x282] - times[0x181] > 150_000


def test_faults_travel_as_eight_bytes() -> None:
    fault = BusFault(FaultKind.CORRUPT, 0x181, 70_000, 2)
    assert BusFault.decode(fault.encode()) == fault
    assert BusFault.decode(b"\xee" + bytes(7)).kind is FaultKind.NONE


def test_the_same_seed_gives_the_same_frames() -> None:
    def run() -> list[object]:
        bench = Bench(encoder_noise_counts=3.0)
        bench.enabled()
        for step in range(200):
            bench.cycle(0x0F, 10 * step)
        return [*bench.heard, bench.world.truth()]

    assert run() == run()


def test_a_filtered_stepped_connection_gets_only_its_identifiers(bench: Bench) -> None:
    filtered = bench.world.connect((0x282,))
    bench.operational()
    bench.cycle(cycles=3)
    identifiers = []
    while (frame := filtered.receive()) is not None:
        identifiers.append(frame.can_id)
    assert set(identifiers) == {0x282}


FRAME = bytes(range(4))


def struck(kind: FaultKind, detail: int = 0, frames: int = 3) -> list[tuple[bytes, float]]:
    """What c hears of some frames of a, 1 ms apart, the first of which is struck: data and ms since its sending."""
    wire, heard = Wire(), []
    wire.ports[2].receive = lambda can_id, data, time_ns: heard.append((data, time_ns))
    wire.hub.faults.arm(kind, 0x181, 1, detail)
    for number in range(frames):
        wire.hub.submit(wire.ports[0], 0x181, FRAME + bytes([number]), number * 1_000_000)
        wire.run(number * 1_000_000 + 900_000)
        while wire.timeline.next_ns() < (number + 1) * 1_000_000:
            wire.timeline.fire_next()
    return [(data, round(time_ns / 1e6, 1)) for data, time_ns in heard]


def test_a_late_frame_comes_later_by_its_detail() -> None:
    assert [time_ms for _, time_ms in struck(FaultKind.LATE, 5)] == [0.6, 1.1, 2.1]


def test_a_frame_can_come_twice() -> None:
    assert [data[-1] for data, _ in struck(FaultKind.DUPLICATE)] == [0, 0, 1, 2]


def test_a_reordered_frame_comes_after_the_next() -> None:
    assert [data[-1] for data, _ in struck(FaultKind.REORDER)] == [1, 0, 2]


def test_a_shortened_frame_lacks_its_end() -> None:
    assert [data for data, _ in struck(FaultKind.SHORTEN, 3, frames=1)] == [FRAME[:2]]
    assert [data for data, _ in struck(FaultKind.SHORTEN, 9, frames=1)] == [b""]


def test_a_flipped_bit_is_the_one_that_was_named() -> None:
    assert [data for data, _ in struck(FaultKind.FLIP, 9, frames=1)] == [bytes([0, 1 ^ 2, 2, 3, 0])]


def test_a_queue_that_stands_fills_and_empties_again() -> None:
    bench = Bench(queue_depth=3)
    bench.bus.inject(BusFault(FaultKind.STUCK, amount=5))
    assert [bench.bus.send(0x7FF, b"") for _ in range(4)] == [True, True, True, False]
    assert bench.bus.counters.queue_full == 1
    bench.pass_time(0.006)
    assert bench.bus.send(0x7FF, b"")


def test_an_interface_that_goes_down_is_up_again_after_its_time() -> None:
    bench = Bench()
    bench.bus.inject(BusFault(FaultKind.DOWN, amount=5))
    assert (bench.bus.counters.down, bench.bus.send(0x7FF, b"")) == (True, False)
    bench.world.clock.sleep_until(bench.world.clock.now_ns() + 6_000_000)
    assert (bench.bus.counters.down, bench.bus.counters.down_events, bench.bus.send(0x7FF, b"")) == (False, 1, True)


def test_a_babbler_sends_until_its_time_is_over() -> None:
    bench = Bench()
    bench.bus.inject(BusFault(FaultKind.BABBLE, 0x123, 10, 2))
    bench.pass_time(0.03)
    assert len(bench.frames(0x123)) == 20


def test_a_second_node_of_the_same_id_boots_and_answers_too() -> None:
    bench = Bench()
    bench.pass_time(0.005)
    assert len(bench.frames(0x702)) == 1
    bench.bus.inject(BusFault(FaultKind.TWIN, participant=2))
    bench.pass_time(0.005)
    assert len(bench.frames(0x702)) == 2
    bench.upload(2, 0x1000)
    bench.pass_time(0.005)
    assert len(bench.frames(0x582)) == 2
