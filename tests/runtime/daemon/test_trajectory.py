"""Motions before the loop is asked: samples that come in pieces, and the check against the limits, with figures."""

import itertools
from pathlib import Path
from typing import Any

import pytest
from daemon_rows import axis_config, record

from servod.common.errors import BadInput, Unreachable
from servod.formats.protocol import SampleKey, Verb
from servod.kernels.motions import PAPER_LONGEST_S
from servod.runtime.daemon.arguments import MotionKind, check_arguments
from servod.runtime.daemon.trajectory import MotionTable, check_motion
from servod.runtime.loop.commands import Refusal
from servod.runtime.loop.references import make_motion


def test_pieces_become_one_column_with_its_extent_and_steps() -> None:
    table = MotionTable()
    table.add(SampleKey.POSITIONS, 0, [9.0])
    for start, piece in ((0, [0.0, 0.1]), (2, [0.4, 0.3])):
        table.add(SampleKey.POSITIONS, start, piece)
    positions = table.positions
    assert list(table.area()) == [0.0, 0.1, 0.4, 0.3]
    assert (positions.lowest, positions.highest, positions.largest_step) == (0.0, 0.4, pytest.approx(0.3))
    with pytest.raises(BadInput, match="or 4 to go on"):
        table.add(SampleKey.POSITIONS, 5, [0.0])
    with pytest.raises(BadInput, match="found 0 samples; allowed: 4"):
        table.require(torques=True)
    with pytest.raises(BadInput, match="at most 300000"):
        table.add(SampleKey.TORQUES, 0, [0.0] * 300_001)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ({"kind": "step", "amplitude_rad": 0.6, "duration_s": 1}, "from 0.5 to 1.1 rad"),
        ({"kind": "sine", "amplitude_rad": 0.4, "frequency_hz": 2, "duration_s": 1}, "5.02655 rad/s"),
        ({"kind": "csv", "positions_rad": [0.0, 0.0051]}, "5.1 rad/s; limits.speed_rad_s allows 5"),
        ({"kind": "csv", "positions_rad": [0.0, -2.0]}, "-1.5 to 0.5 rad"),
    ],
)
def test_motion_is_checked_with_figures_before_the_loop_is_asked(args: dict[str, Any], says: str) -> None:
    track = check_arguments(Verb.TRACK, args)
    table = track.table(MotionTable())
    config = axis_config(Path("s"), Path("c"))
    limits = config.limits.model_copy(update={"speed_rad_s": 5.0})
    with pytest.raises(Unreachable) as caught:
        check_motion(
            track.reference(table), table, config.model_copy(update={"limits": limits}), record(reference_rad=0.5)
        )
    assert says in str(caught.value)


def test_more_of_the_papers_trajectory_than_there_is_is_bad_input() -> None:
    track = check_arguments(Verb.TRACK, {"kind": "paper", "duration_s": 40})
    with pytest.raises(BadInput) as caught:
        track.reference(MotionTable())
    assert (caught.value.where, caught.value.found) == ("track paper: duration_s", "40 s")
    assert "at most 30.303 s" in caught.value.allowed


EXTREMES = {
    "amplitude_rad": (-1e4, -1e-300, 0.0, 1e4),
    "frequency_hz": (1e-300, 500.0),
    "duration_s": (1e-300, PAPER_LONGEST_S, 86_400.0),
    "window_rad": (1e-300, 1e4),
}


@pytest.mark.parametrize("kind", [MotionKind.SINE, MotionKind.PAPER, MotionKind.STEP, MotionKind.EXCITE])
def test_no_argument_that_is_allowed_is_refused_without_saying_which(kind: MotionKind) -> None:
    """The loop's refusal of a bad argument names none; what it means is found before."""
    table = {"positions_rad": [0.0, 0.0], "torques_nm": [0.0, 0.0]} if kind is MotionKind.EXCITE else {}
    for values in itertools.product(*EXTREMES.values()):
        if kind is MotionKind.PAPER and values[2] > PAPER_LONGEST_S:
            continue
        track = check_arguments(Verb.TRACK, {"kind": kind, **dict(zip(EXTREMES, values, strict=True)), **table})
        motion = make_motion(track.reference(track.table(MotionTable())), 1e-3, [0.0, 0.0] * 2)
        assert not isinstance(motion, Refusal), values


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (
            {"kind": "step", "amplitude_rad": -0.2, "duration_s": 1},
            "track step: amplitude_rad: found a reference 0.21 rad from the joint at once; allowed: at most "
            "limits.following_error_rad, 0.205 rad; take a smaller step, or a ramp from a file (`servoctl track csv`)",
        ),
        (
            {"kind": "csv", "positions_rad": [0.1, 0.2, 0.41]},
            "csv: positions_rad: found a reference that jumps by 0.21 rad",
        ),
        ({"kind": "sine", "amplitude_rad": 0.25, "frequency_hz": 200, "duration_s": 1}, "sine: frequency_hz: found"),
        (
            {"kind": "excite", "positions_rad": [0.0, -0.3], "torques_nm": [0.0, 0.0], "window_rad": 1},
            "excite: positions_rad: found a reference 0.31 rad from the joint at once",
        ),
    ],
)
def test_a_jump_beyond_the_following_error_is_bad_input(args: dict[str, Any], line: str) -> None:
    track = check_arguments(Verb.TRACK, args)
    table = track.table(MotionTable())
    config = axis_config(Path("s"), Path("c"))
    limits = config.limits.model_copy(update={"speed_rad_s": 1e3, "following_error_rad": 0.205})
    now = record(reference_rad=0.5, position_rad=0.51)
    with pytest.raises(BadInput) as caught:
        check_motion(track.reference(table), table, config.model_copy(update={"limits": limits}), now)
    assert line in str(caught.value)
