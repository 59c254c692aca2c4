"""What nodes owe: one frame of each kind for each SYNC, however late, and nothing beyond it."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from servod.runtime.fieldbus.bus import Frame
from servod.runtime.loop.answers import Answers

POSITION, STATUS = 0x282, 0x181
CYCLE_NS = 1_000_000
REPEATED_NS = 500_000


def cycle(answers: Answers, number: int, *arrivals: tuple[int, bytes]) -> list[bool]:
    """SYNC, a microsecond for each frame, and whether each is a node's own."""
    sync_ns = number * CYCLE_NS
    answers.ask(sync_ns)
    own = [answers.take(Frame(i, data, sync_ns + 1000 * k)) for k, (i, data) in enumerate(arrivals, 1)]
    if {can_id for can_id, _ in arrivals} == {POSITION, STATUS}:
        answers.complete()
    return own


def own(number: int) -> tuple[tuple[int, bytes], tuple[int, bytes]]:
    data = number.to_bytes(4, "little")
    return (STATUS, data), (POSITION, data)


@settings(max_examples=200, deadline=None)
@given(stalls=st.lists(st.tuples(st.integers(0, 120), st.integers(1, 80), st.sampled_from([POSITION, STATUS]))))
def test_what_comes_late_and_in_order_is_never_foreign(stalls: list[tuple[int, int, int]]) -> None:
    """Each node stands still for a while and then sends all that it owes in one cycle."""
    answers, number = Answers([POSITION, STATUS], REPEATED_NS), 0
    held: dict[int, list[tuple[int, bytes]]] = {POSITION: [], STATUS: []}
    for between, length, stuck in stalls:
        for k in range(between + length):
            arrivals = []
            for can_id, data in own(number):
                held[can_id].append((can_id, data))
                if can_id != stuck or k < between:
                    arrivals += held[can_id]
                    held[can_id] = []
            assert all(cycle(answers, number, *arrivals))
            number += 1


@given(lost=st.integers(1, 30), moves=st.booleans())
def test_behind_a_loss_one_frame_passes_and_the_second_is_foreign(lost: int, moves: bool) -> None:
    answers = Answers([POSITION, STATUS], REPEATED_NS)
    for number in range(lost):
        cycle(answers, number, own(number)[0])
    for number in range(lost, lost + 110):
        assert all(cycle(answers, number, *own(number * moves)))
    number = lost + 110
    assert cycle(answers, number, *own(number * moves), (POSITION, b"else")) == [True] * 3
    assert cycle(answers, number + 1, *own(number * moves), (POSITION, b"more")) == [True, True, False]


def test_of_a_lone_frame_one_copy_passes() -> None:
    answers = Answers([POSITION, STATUS], REPEATED_NS)
    status, position = own(7)
    assert cycle(answers, 0, status, position, position) == [True] * 3
    assert cycle(answers, 1, status, position, position, position) == [True] * 3 + [False]
    assert cycle(answers, 2, status, position, (POSITION, b"else")) == [True, True, False]


def test_a_copy_that_comes_later_is_foreign() -> None:
    answers = Answers([POSITION, STATUS], REPEATED_NS)
    status, position = own(7)
    cycle(answers, 0, status, position)
    assert not answers.take(Frame(*position, REPEATED_NS + 3000))
