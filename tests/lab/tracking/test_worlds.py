"""The whole CAN loop and the simulator agree, and a measurement says what became of the axis."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from servod.client.axis import ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.errors import AnswerIsNo
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.simulate.simulate import LoopSettings
from servod.lab.tracking import metrics, stepped
from servod.lab.tracking.metrics import paper_rows, roughness, score

COUNTS = 2**20
CUTOFF_HZ = 120.0  # the default of the configuration


@pytest.fixture(scope="module")
def plant() -> AxisModel:
    return load_axis_model(shipped("gains/axes/demo_joint.yaml")).model_copy(update={"thermal": None})


def axis_of(plant: AxisModel, folder: Path) -> SteppedAxis:
    return SteppedAxis(virtual_session(plant, folder, COUNTS, 7), folder)


def set_of(law: str) -> GainSet:
    return load_gains(shipped(f"gains/demo_{law}.yaml"))


@pytest.mark.parametrize("law", ["pd_dob", "local"])
def test_the_simulator_tracks_as_the_can_loop_does(plant: AxisModel, tmp_path: Path, law: str) -> None:
    axis = axis_of(plant, tmp_path)
    stepped.activate(axis, set_of(law))
    measured = stepped.run_motion(axis, ReferenceMotion.paper(5.0))
    loop = LoopSettings(0.001, COUNTS, CUTOFF_HZ, 0.3)
    followed = metrics.curves_of(metrics.run(plant, set_of(law), paper_rows(0.001, 5.0), loop, 7))
    assert len(measured.time_s) == pytest.approx(len(followed.time_s), abs=2)
    on_can, alone = (score(c.time_s, c.error_mrad).rms_error_mrad for c in (measured, followed))
    assert on_can == pytest.approx(alone, rel=0.05)
    rough = [roughness(c.time_s, c.torque_nm) for c in (measured, followed)]
    assert rough[0] == pytest.approx(rough[1], rel=0.1)


def test_a_whole_measurement_has_trajectory_steps_and_curves(
    plant: AxisModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stepped, "PAPER_S", 3.0)
    monkeypatch.setattr(stepped, "HOLD_S", 2.5)
    told: list[float] = []
    found = stepped.measure(lambda: axis_of(plant, tmp_path), set_of("local"), told.append)
    assert told == sorted(told) and told[-1] == pytest.approx(1.0)
    assert found.rms_error_mrad < found.max_error_mrad < 1.0
    assert list(found.steps) == [100.0, 10.0]
    for size, response in found.steps.items():
        curves = found.curves[f"step_{size:g}"]
        assert curves.reference_rad[0] == pytest.approx(size * 1e-3)
        assert abs(curves.position_rad[0]) < 5e-4  # each step counts from where the last is held
        assert response.settling_s is not None and response.settling_s < 0.5
        assert response.steady_error_mrad < 0.3
        assert 0.0 < response.hold_mrad < response.hold_encoder_mrad
    parts = found.curves["paper"]
    whole = parts.feedback_nm + parts.friction_nm + parts.other_nm
    assert whole == pytest.approx(parts.torque_nm, abs=1e-9)


def test_a_motion_that_the_axis_refuses_is_told(plant: AxisModel, tmp_path: Path) -> None:
    axis = axis_of(plant, tmp_path)
    stepped.activate(axis, set_of("pd"))
    with pytest.raises(AnswerIsNo, match="would leave limits"):
        stepped.run_motion(axis, ReferenceMotion.step(5.0, 1.0))


class Watch(stepped.Swing):
    """A swing that notes when it looks."""

    def __init__(self) -> None:
        super().__init__()
        self.looks_s: list[float] = []

    def look(self, axis: SteppedAxis, passed_s: float) -> None:
        self.looks_s.append(passed_s)
        super().look(axis, passed_s)


def test_a_hold_is_looked_at_in_every_cycle(plant: AxisModel, tmp_path: Path) -> None:
    """A slower look sees nothing of a joint that swings at a multiple of its rate."""
    axis, watch = axis_of(plant, tmp_path), Watch()
    stepped.activate(axis, set_of("local"))
    stepped.run_motion(axis, ReferenceMotion.step(0.01, 0.6), swing=watch)
    apart_s = [after - before for before, after in pairwise(watch.looks_s)]
    assert max(apart_s) == pytest.approx(axis.session.cycle.period_ns * 1e-9)
