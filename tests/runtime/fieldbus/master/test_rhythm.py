"""Who comes between the beats of one sender is told from a sender whose beats come late."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from servod.runtime.fieldbus.master.monitor import Rhythm

PERIOD_NS = 50_000_000


def arrivals(stalls: list[tuple[float, float]], periods: float, beats: int) -> list[int]:
    """Beats of a node whose period is `periods` of ours, on a bus that stalls from and for so many periods."""
    found = []
    for beat in range(beats):
        time = beat * periods
        for begin, length in sorted(stalls):  # what a stall lets go may fall into the next
            time = begin + length if begin <= time < begin + length else time
        found.append(round(time * PERIOD_NS))
    return found


def blamed(times_ns: list[int]) -> list[int]:
    rhythm = Rhythm(PERIOD_NS)
    return [time_ns for time_ns in times_ns if rhythm.foreign(time_ns)]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.floats(0.5, 60), st.floats(0.01, 20)), max_size=6), st.floats(0.98, 1.02))
def test_beats_that_come_late_and_then_in_time_are_of_one_sender(
    stalls: list[tuple[float, float]], periods: float
) -> None:
    assert blamed(arrivals(stalls, periods, 100)) == []


@given(st.floats(0.0, 0.999), st.floats(0.99, 1.01), st.integers(10, 60))
def test_a_stranger_is_told_within_half_a_period_or_little_more(phase: float, periods: float, after: int) -> None:
    times_ns = arrivals([], periods, 80)
    stranger_ns = times_ns[after] + round(phase * periods * PERIOD_NS)
    (first, *_) = blamed(sorted([*times_ns, stranger_ns]))
    assert 0 <= first - stranger_ns <= 0.6 * PERIOD_NS


@given(st.floats(0.0, 0.999), st.sampled_from([60, 100, 200, 500, 1000]), st.floats(0.99, 1.01))
def test_a_slow_beat_is_known_as_soon_as_a_fast_one(phase: float, period_ms: int, clock: float) -> None:
    """A second or two periods after the begin somebody else is told, by the next beat of the node at the latest."""
    period_ns = period_ms * 1_000_000
    rhythm, after = Rhythm(period_ns), max(2, 800 // period_ms)
    stranger_ns = round((after + phase) * clock * period_ns)
    times_ns = sorted([*(round(beat * clock * period_ns) for beat in range(40)), stranger_ns])
    told_ns = [time_ns for time_ns in times_ns if rhythm.foreign(time_ns)]
    assert 0 <= told_ns[0] - stranger_ns <= 0.6 * period_ns


def test_a_sender_that_begins_anew_is_not_judged_by_what_was() -> None:
    rhythm = Rhythm(PERIOD_NS)
    assert not any(rhythm.foreign(beat * PERIOD_NS) for beat in range(10))
    rhythm.restart(round(9.3 * PERIOD_NS))
    assert not any(rhythm.foreign(round((beat + 0.1) * PERIOD_NS)) for beat in range(10, 20))
