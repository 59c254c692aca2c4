"""Recordings as they come: repaired with a note, or refused with the reason."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.kernels.laws import LAWS
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.engine import diagnose
from servod.lab.diagnose.judge.verdict import below_noise
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.diagnose.result import DiagnosisVerdict
from servod.lab.recordings import Quantity, Recording
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from tests.lab.diagnose.axes import believed, record, recording, references

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def made() -> Recording:
    return record(believed())[1]


def refused_for(bad: Recording) -> str:
    traces, refused = load_traces([bad], believed())
    assert traces == []
    return refused[0].reason


def test_good_recording_is_taken(made: Recording) -> None:
    traces, refused = load_traces([made], believed())
    assert refused == []
    assert traces[0].notes == ()


@pytest.mark.parametrize(
    ("shown_c", "changes"),
    [
        (lambda share: np.round(29.0 + 1.4 * np.sin(9.0 * share)), False),  # 28, 29 and 30: the last digit flickers
        (lambda share: np.full_like(share, 29.0), False),
        (lambda share: np.round(29.0 + 6.0 * share), True),
        (lambda share: np.round(29.0 + 1.2 * share, 2), True),
    ],
)
def test_a_thermometer_must_show_more_than_its_last_digit(
    made: Recording, shown_c: Callable[[Array], Array], changes: bool
) -> None:
    share = np.linspace(0.0, 1.0, len(made))
    warm = replace(made, columns={**made.columns, Quantity.TEMPERATURE: shown_c(share)})
    (trace,), _ = load_traces([warm], believed())
    assert trace.has_temperature is changes


def test_too_short(made: Recording) -> None:
    assert "too short" in refused_for(recording(made.t_s[:900], made.torque[:900], made.position[:900]))


def test_too_coarse_or_in_another_unit(made: Recording) -> None:
    said = refused_for(recording(1000.0 * made.t_s, made.torque, made.position))
    assert "too coarse: 1 s between rows, at most 0.1 s; t_s is in seconds" in said


def test_too_still(made: Recording) -> None:
    still = np.round(1e-6 * np.sin(made.t_s) / 6e-6) * 6e-6
    assert "too still" in refused_for(recording(made.t_s, made.torque, still))


def test_too_noisy(made: Recording) -> None:
    noise = np.random.default_rng(1).normal(size=len(made.t_s)) * 0.3
    assert "too noisy" in refused_for(recording(made.t_s, made.torque, made.position + noise))


def test_saturated(made: Recording) -> None:
    most = 0.2 * float(np.median(np.abs(made.torque)))
    assert "saturated" in refused_for(recording(made.t_s, np.clip(made.torque, -most, most), made.position))


def test_a_drive_at_its_limit_is_recorded_as_well_as_another() -> None:
    """A loop that asks for all there is: the command goes from one limit to the other, and the joint by no more."""
    many, limits = references(5.0)[1], LoopSettings(counts_per_turn=2.0**20, torque_limit_nm=0.3)
    run = simulate_closed_loop(believed(), LAWS["pd"], (400.0, 9.0, 0.0), many, limits)
    at_limit = float(np.mean(np.abs(run.torque_nm) == 0.3))
    assert at_limit > 0.4
    traces, refused = load_traces([recording(run.t_s, run.torque_nm, run.encoder_rad)], believed())
    assert refused == []
    assert traces[0].notes == (f"command: at its limit in {100.0 * at_limit:.0f} % of the rows",)
    cut = recording(run.t_s, np.clip(run.torque_nm, -0.15, 0.15), run.encoder_rad)
    assert re.search("and the motion there needs [12][.0-9]* times as much$", refused_for(cut))


def test_wrong_sign_and_unit(made: Recording) -> None:
    assert "opposite signs" in refused_for(recording(made.t_s, -made.torque, made.position))
    assert "another unit" in refused_for(recording(made.t_s, 1000.0 * made.torque, made.position))


def test_glitches_and_turns_are_repaired(made: Recording) -> None:
    position, torque = made.position.copy(), made.torque.copy()
    position[1200] += 3.0
    torque[2000] = 65535.0
    traces, _ = load_traces([recording(made.t_s, torque, position)], believed())
    assert [note.split(":")[0] for note in traces[0].notes] == ["position", "command"]
    assert abs(traces[0].drive.position[1200] - made.position[1200]) < 1e-3
    assert not traces[0].counts[1200]
    turned = made.position + 2.0 * np.pi * (made.t_s > 2.5)
    traces, _ = load_traces([recording(made.t_s, made.torque, turned)], believed())
    assert "whole turn" in traces[0].notes[0]


def test_nothing_that_can_tell_is_said_so(made: Recording) -> None:
    found = diagnose(believed(), [recording(made.t_s[:900], made.torque[:900], made.position[:900])])
    assert found.verdict is DiagnosisVerdict.CANNOT_TELL
    assert found.evidence is None


def test_command_that_never_changes(made: Recording) -> None:
    assert "never changes" in refused_for(recording(made.t_s, np.full(len(made), 0.1), made.position))


def test_position_in_degrees_or_counts(made: Recording) -> None:
    assert "degrees" in refused_for(recording(made.t_s, made.torque, np.degrees(made.position)))
    counts = np.round(made.position / (2.0 * np.pi) * 2.0**20)
    assert "counts" in refused_for(recording(made.t_s, made.torque, counts))


def test_physics_that_is_missing_is_no_wrong_unit() -> None:
    """A weight ten times the friction, a torque constant off by a half, a third of the inertia: all are taken in."""
    heavy = believed(gravity={"amplitude": 1.2, "phase": 0.3})
    weak, light = believed(torque_gain={"factor": 0.5}), believed(inertia=0.007)
    for true in (heavy, weak, light):
        assert load_traces(record(true)[1:2], believed())[1] == []


def test_several_rows_of_telemetry_that_lies(made: Recording) -> None:
    torque = made.torque.copy()
    torque[1500:1502] = torque[3000] = 65535.0
    traces, refused = load_traces([recording(made.t_s, torque, made.position)], believed())
    assert refused == []
    assert traces[0].notes == ("command: 3 glitches, the first in row 1501, replaced",)
    assert np.max(np.abs(traces[0].drive.torque - made.torque)) < 0.5 * np.ptp(made.torque)


@pytest.mark.parametrize("every", [2, 5])
def test_slow_and_uneven_sampling_is_taken(made: Recording, every: int) -> None:
    """200 and 500 Hz, stamps that jitter, and a hole in the middle."""
    rows = np.arange(0, len(made), every)
    rows = rows[(rows < 2000) | (rows > 2300)]
    jitter = np.random.default_rng(1).uniform(-2e-4, 2e-4, len(rows))
    traces, refused = load_traces(
        [recording(made.t_s[rows] + jitter, made.torque[rows], made.position[rows])], believed()
    )
    assert refused == []
    assert len(traces[0].starts) == 2


def test_long_list_of_unused_columns_is_cut(made: Recording) -> None:
    names = ", ".join(f"column{i}" for i in range(30))
    told = Recording(made.path, made.axis, made.columns, made.measured, (f"columns not used: {names}",))
    note = load_traces([told], believed())[0][0].notes[0]
    assert note.endswith("column5 and 24 more")


def test_a_command_that_is_nothing_at_all_is_refused(made: Recording) -> None:
    assert "the command never changes" in refused_for(recording(made.t_s, 0.0 * made.torque, made.position))


def test_noise_that_hides_what_is_left_is_no_finding_of_physics(made: Recording) -> None:
    """Noise of 10 mrad: too little to refuse the recording, too much to say what is left."""
    noise = np.random.default_rng(1).normal(size=len(made.t_s)) * 0.01
    model = believed()
    predictor = Predictor(load_traces([recording(made.t_s, made.torque, made.position + noise)], model)[0], model)
    assert predictor.encoder_noise == pytest.approx(model.inertia * predictor.rate**2 * 0.01, rel=0.1)
    assert below_noise(DiagnosisVerdict.UNEXPLAINED, predictor.encoder_noise, predictor.dry)
    assert not below_noise(DiagnosisVerdict.MISSING_PHYSICS, predictor.encoder_noise, predictor.dry)
    quiet = Predictor(load_traces([made], model)[0], model)
    assert not below_noise(DiagnosisVerdict.UNEXPLAINED, quiet.encoder_noise, quiet.dry)


def test_steps_and_square_waves_are_at_no_limit() -> None:
    from servod.lab.diagnose.data.intake import _at_limit

    t_s = np.arange(4000) * 1e-3
    assert _at_limit(np.sign(np.sin(9.0 * t_s) + 1e-9)) == 0.0
    assert _at_limit(np.where(np.sin(9.0 * t_s) > 0.2, 1.0, 0.25)) == 0.0
    noise = 0.05 * np.random.default_rng(1).normal(size=len(t_s))
    assert _at_limit(np.clip(2.0 * np.sin(9.0 * t_s) + noise, -1.0, 1.0)) > 0.4
    assert _at_limit(np.clip(9.0 * np.sin(9.0 * t_s), -1.0, 1.0)) > 0.4
