"""Recordings that no fit has seen: judged by what was found, and refused where a fit sees them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servod.cli.diagnose import _need_unseen
from servod.common.errors import BadInput
from servod.lab.diagnose.judge.free_run import coasting, judge_held_out
from servod.lab.simulate.replay import window_starts
from tests.lab.diagnose.axes import believed, record


def test_a_recording_is_judged_by_both_models_and_by_coasting() -> None:
    true = believed(gravity={"amplitude": 0.1, "phase": 0.5})
    (found,) = judge_held_out(believed(), true, record(true, seconds=2.0)[1:2])
    assert found.name == "run1.csv"
    for window in found.windows:
        assert window.after < 0.1 * window.before
        assert window.after < 0.1 * window.coasting


def test_coasting_is_right_where_the_speed_stays() -> None:
    made = record(believed(), seconds=2.0)[0]
    drive = made.drive
    straight = replace(drive, position=0.3 * drive.t_s)
    assert np.allclose(coasting(straight, window_starts(drive.t_s, 0.25)), 0.0, atol=1e-6)


def test_a_recording_that_a_fit_sees_is_not_held_out() -> None:
    one, other, _ = record(believed(), seconds=2.0)
    copied = replace(one, path=Path("copy.csv"))
    _need_unseen([other], [one])
    with pytest.raises(BadInput, match="a recording that no fit sees"):
        _need_unseen([copied], [other, one])
