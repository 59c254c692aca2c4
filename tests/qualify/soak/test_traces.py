"""What a listener must hear of a fault that the axis rides through, and what sound traffic does not show."""

from __future__ import annotations

import random

import pytest

from servod.qualify.faults.actions import action_of
from servod.qualify.faults.scenario import Runs
from servod.qualify.soak.kinds import KINDS, InjectionKind
from servod.qualify.soak.traces import BusSign, Heard, Sign, shows, trace_of
from servod.runtime.fieldbus.cia import SYNC_ID

TORQUE, BEAT = 0x201, 0x77E
SYNC, FRAME = Heard(SYNC_ID, b""), Heard(TORQUE, bytes(4))


def traffic(*frames: int, every: int = 1, can_id: int = TORQUE) -> list[Heard]:
    """SYNC frames with so many frames behind each; `every`: with so many SYNCs in a row for each number."""
    return [h for n in frames for h in [SYNC] * every + [Heard(can_id, bytes(4))] * n]


@pytest.mark.parametrize(
    ("sign", "heard"),
    [
        (Sign.GAP, traffic(1, 1, 0, 1, 1)),
        (Sign.CROWD, traffic(1, 1, 0, 2, 1)),
        (Sign.CROWD, traffic(1, 1, 2, 1)),
        (Sign.SHORT, [*traffic(1, 1), SYNC, Heard(TORQUE, bytes(3))]),
        (Sign.HEARD, traffic(0, 0, 1)),
    ],
)
def test_a_trace_is_seen_in_traffic_that_bears_it(sign: Sign, heard: list[Heard]) -> None:
    assert shows(BusSign(sign, TORQUE), heard, 0)
    assert not shows(BusSign(sign, BEAT), heard, 9)


@pytest.mark.parametrize("sign", [Sign.GAP, Sign.CROWD, Sign.SHORT])
def test_sound_traffic_and_none_bear_no_trace(sign: Sign) -> None:
    for heard in (traffic(1, 1, 1, 1), [FRAME, *traffic(1, 1, 1)], [SYNC, SYNC], [FRAME], []):
        assert not shows(BusSign(sign, TORQUE), heard, 0)


@pytest.mark.parametrize(("beats", "gap"), [((1, 1, 1, 1), False), ((1, 1, 0, 1, 1), True)])
def test_a_frame_that_comes_with_every_fiftieth_sync_is_missed_alike(beats: tuple[int, ...], gap: bool) -> None:
    assert shows(BusSign(Sign.GAP, BEAT), traffic(*beats, every=50, can_id=BEAT), 0) is gap


def test_error_frames_are_a_trace() -> None:
    assert shows(BusSign(Sign.DESTROYED, TORQUE), [], 1) and not shows(BusSign(Sign.DESTROYED, TORQUE), [FRAME], 0)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if not kind.expects], ids=lambda kind: kind.name)
def test_every_kind_that_is_ridden_through_has_a_trace(kind: InjectionKind) -> None:
    for seed in range(5):
        assert trace_of(action_of(kind.injection(random.Random(seed)), kind.name, Runs.STEPPED)) is not None
