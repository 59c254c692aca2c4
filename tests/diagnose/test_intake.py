"""Recordings as they come: repaired with a note, or refused with the reason."""

from __future__ import annotations

import numpy as np
import pytest

from servod.diagnose.engine import diagnose
from servod.diagnose.intake import taken_in
from servod.diagnose.verdict import Verdict
from servod.recordings import Recording
from tests.diagnose.axes import believed, record, recording


@pytest.fixture(scope="module")
def made() -> Recording:
    return record(believed())[1]


def refused_for(bad: Recording) -> str:
    traces, refused = taken_in([bad], believed())
    assert traces == []
    return refused[0].reason


def test_good_recording_is_taken(made: Recording) -> None:
    traces, refused = taken_in([made], believed())
    assert refused == []
    assert traces[0].notes == ()


def test_too_short(made: Recording) -> None:
    assert "too short" in refused_for(recording(made.t_s[:900], made.torque[:900], made.position[:900]))


def test_too_still(made: Recording) -> None:
    still = np.round(1e-6 * np.sin(made.t_s) / 6e-6) * 6e-6
    assert "too still" in refused_for(recording(made.t_s, made.torque, still))


def test_too_noisy(made: Recording) -> None:
    noise = np.random.default_rng(1).normal(size=len(made.t_s)) * 0.3
    assert "too noisy" in refused_for(recording(made.t_s, made.torque, made.position + noise))


def test_saturated(made: Recording) -> None:
    most = 0.2 * float(np.median(np.abs(made.torque)))
    assert "saturated" in refused_for(recording(made.t_s, np.clip(made.torque, -most, most), made.position))


def test_wrong_sign_and_unit(made: Recording) -> None:
    assert "opposite signs" in refused_for(recording(made.t_s, -made.torque, made.position))
    assert "another unit" in refused_for(recording(made.t_s, 1000.0 * made.torque, made.position))


def test_glitches_and_turns_are_repaired(made: Recording) -> None:
    position, torque = made.position.copy(), made.torque.copy()
    position[1200] += 3.0
    torque[2000] = 65535.0
    traces, _ = taken_in([recording(made.t_s, torque, position)], believed())
    assert [note.split(":")[0] for note in traces[0].notes] == ["position", "command"]
    assert abs(traces[0].drive.position[1200] - made.position[1200]) < 1e-3
    assert not traces[0].counts[1200]
    turned = made.position + 2.0 * np.pi * (made.t_s > 2.5)
    traces, _ = taken_in([recording(made.t_s, made.torque, turned)], believed())
    assert "whole turn" in traces[0].notes[0]


def test_nothing_that_can_tell_is_said_so(made: Recording) -> None:
    found = diagnose(believed(), [recording(made.t_s[:900], made.torque[:900], made.position[:900])])
    assert found.verdict is Verdict.CANNOT_TELL
    assert found.evidence is None
