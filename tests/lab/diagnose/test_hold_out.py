"""Recordings that no fit has seen: judged by what was found, and refused where a fit sees them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servod.cli.app import app
from servod.common.errors import BadInput
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.diagnose.judge.free_run import coasting, judge_held_out
from servod.lab.recordings import Quantity, Recording
from servod.lab.recordings.same import are_same, need_distinct
from servod.lab.simulate.replay import window_starts
from tests.lab.diagnose.axes import believed, record, write_csv


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


def copies(one: Recording) -> dict[str, Recording]:
    """One recording as it comes again: under another name, on another clock, with fewer digits, or a part of it."""
    copied = replace(one, path=Path("copy.csv"))
    columns = {quantity: np.round(values, 7) for quantity, values in one.columns.items()}
    later = one.columns | {Quantity.TIME: one.t_s + 12.25}
    return {
        "name": copied,
        "clock": replace(copied, columns=later),
        "digits": replace(copied, columns=columns),
        "part": copied.between(0.5, 1.5),
    }


@pytest.mark.parametrize("how", ["name", "clock", "digits", "part"])
def test_a_recording_that_a_fit_sees_is_not_held_out(how: str) -> None:
    one, other, _ = record(believed(), seconds=2.0)
    need_distinct([other], [one])
    with pytest.raises(BadInput, match=r"--hold-out copy\.csv: found rows of run0\.csv.*a recording that no fit sees"):
        need_distinct([other, one], [copies(one)[how]])


@pytest.mark.parametrize("how", ["name", "clock", "digits", "part"])
def test_a_recording_counts_once(how: str) -> None:
    one, other, third = record(believed(), seconds=2.0)
    need_distinct([one, other, third])
    with pytest.raises(BadInput, match=r"copy\.csv: found the rows of run0\.csv again.*each recording once"):
        need_distinct([one, other, copies(one)[how]])
    with pytest.raises(BadInput, match="each recording once"):
        need_distinct([other], [one, copies(one)[how]])


def test_two_runs_of_one_motion_are_two_recordings() -> None:
    """By an encoder of a thousand counts as well, where many rows are alike."""
    one, other = (record(believed(), seconds=2.0, seed=seed)[0] for seed in (1, 2))
    assert not are_same(one, other)
    count = 2.0 * np.pi / 1024
    coarse = (
        replace(run, columns=run.columns | {Quantity.POSITION: count * np.round(run.position / count)})
        for run in (one, other)
    )
    assert not are_same(*coarse)


def test_two_recordings_at_rest_are_not_one() -> None:
    one = record(believed(), seconds=2.0)[0]
    still = {quantity: np.zeros(len(one)) for quantity in one.columns} | {Quantity.TIME: one.t_s}
    assert not are_same(replace(one, columns=still), replace(one, columns=still))


def test_the_command_names_both_files(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text(axis_model_yaml(believed()))
    made = record(believed(), seconds=2.0)[0]
    files = [tmp_path / "one.csv", tmp_path / "same.csv"]
    for file in files:
        write_csv(made, file)
    out = tmp_path / "out"
    run = CliRunner().invoke(
        app, ["diagnose", "--model", str(tmp_path / "model.yaml"), *map(str, files), "--out", str(out)]
    )
    assert isinstance(run.exception, BadInput) and run.exception.exit_code == 2
    assert all(str(file) in str(run.exception) for file in files)
    assert not out.exists()
