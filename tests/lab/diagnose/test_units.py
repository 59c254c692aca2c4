"""Commands and positions in another unit: refused in plain words, and questions of the importer are passed on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servod.cli.app import app
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.recordings import Quantity, Recording
from tests.lab.diagnose.axes import believed, record, write_csv

#: A motor of 0.5 N*m/A behind a current drive.
K_T = 0.5


@pytest.fixture(scope="module")
def weighted() -> Recording:
    """A weight of many dry frictions that the model does not know."""
    return record(believed(gravity={"amplitude": 2.0, "phase": 0.5}), seconds=4.0)[0]


def refused(made: Recording, model: AxisModel) -> str:
    """Why the recording cannot tell; nothing where it can."""
    traces, reasons = load_traces([made], model)
    assert len(traces) + len(reasons) == 1
    return reasons[0].reason if reasons else ""


@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("drive", [False, True])
def test_a_current_in_milliamperes_is_refused(weighted: Recording, factor: float, drive: bool) -> None:
    """Behind a drive that is told a current as well, where a weight of 2,952 N*m was named (0.81)."""
    columns = dict(weighted.columns)
    torque = columns.pop(Quantity.TORQUE)
    told = {Quantity.CURRENT: torque / K_T} if drive else {Quantity.TORQUE: torque}
    model = believed(drive={"kind": "current", "k_t": K_T}) if drive else believed()
    assert refused(replace(weighted, columns=columns | told), model) == ""
    wrong = {quantity: factor * values for quantity, values in told.items()}
    assert "times what the model needs: another unit" in refused(replace(weighted, columns=columns | wrong), model)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_friction_need_not_show_where_the_motion_is_beyond_reason(factor: float) -> None:
    """An axis without any to speak of: what is known of it is its mass alone."""
    free = {"kind": "coulomb_viscous", "viscous": 0.02, "coulomb": 1e-4}
    made = record(believed(friction=free), seconds=4.0)[1]
    model = believed(friction=free)
    assert refused(made, model) == ""
    wrong = replace(made, columns=made.columns | {Quantity.TORQUE: factor * made.torque})
    assert "another unit, or another axis" in refused(wrong, model)


def test_the_importers_question_is_in_the_answer_and_on_the_terminal(tmp_path: Path) -> None:
    (tmp_path / "model.yaml").write_text(axis_model_yaml(believed()))
    made = record(believed(), seconds=4.0)[0]
    degrees = replace(made, columns=made.columns | {Quantity.POSITION: np.degrees(made.position)})
    write_csv(degrees, tmp_path / "run.csv")
    given = ["diagnose", "--model", str(tmp_path / "model.yaml"), str(tmp_path / "run.csv")]
    run = CliRunner().invoke(app, [*given, "--out", str(tmp_path / "out")])
    assert run.exit_code == 1
    assert "note: run.csv: position_rad: position spans" in run.stdout
    assert "degrees? (unit: deg in a --map file)" in run.stdout
    (recording,) = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["recordings"]
    assert any("degrees?" in note for note in recording["notes"])
