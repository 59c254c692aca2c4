"""The shipped gain sets on the joints they are for, by the compiled simulator: trajectory (19) and steps.

The bounds are what the sets reach with room for another machine's rounding, not what the paper measured.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.kernels.motions import paper
from servod.lab.simulate.simulate import ClosedLoopRun, LoopSettings, simulate_closed_loop

GAINS = Path(__file__).resolve().parents[3] / "gains"
SETTINGS = LoopSettings(torque_limit_nm=0.5)
Array = NDArray[np.float64]


def trajectory_19(seconds: float = 30.0) -> Array:
    """Rows of position, velocity, acceleration of x_ref = (0.1 - 0.0033 t) sin(0.2 pi t)."""
    return np.array([paper(k * 1e-3) for k in range(int(seconds * 1000))])


def run(gain_set: str, model: AxisModel, reference: Array, settings: LoopSettings = SETTINGS) -> ClosedLoopRun:
    gains = load_gains(GAINS / f"{gain_set}.yaml")
    return simulate_closed_loop(model, gains.law, gains.pack(), reference, settings)


def rms_mrad(gain_set: str, model: AxisModel, settings: LoopSettings = SETTINGS) -> float:
    """RMS error on (19) without the first second."""
    error = run(gain_set, model, trajectory_19(), settings).tracking_error_rad(after_s=1.0)
    return float(np.sqrt(np.mean(error**2))) * 1e3


@pytest.fixture(scope="module")
def demo_joint() -> AxisModel:
    return load_axis_model(GAINS / "axes" / "demo_joint.yaml")


@pytest.fixture(scope="module")
def table1_joint() -> AxisModel:
    return load_axis_model(GAINS / "axes" / "table1_joint.yaml")


def with_friction(model: AxisModel, scale: float) -> AxisModel:
    """The joint with all dry friction scaled."""
    dry = {key: getattr(model.friction, key) * scale for key in ("coulomb", "static")}
    return model.model_copy(update={"friction": model.friction.model_copy(update=dry)})


def test_the_papers_order_at_equal_feedback(demo_joint: AxisModel) -> None:
    error = {name: rms_mrad(f"demo_{name}", demo_joint) for name in ("pd", "pd_dob", "pd_lugre", "local")}
    assert error["pd"] > 15.0
    assert max(error["pd_dob"], error["pd_lugre"]) < 1.0
    assert error["local"] < 0.08
    assert error["local"] < 0.2 * min(error["pd_dob"], error["pd_lugre"])


@pytest.mark.parametrize(("name", "bound_mrad"), [("demo_local_plain", 0.25), ("demo_local_stiff", 0.04)])
def test_the_other_demo_sets(demo_joint: AxisModel, name: str, bound_mrad: float) -> None:
    assert rms_mrad(name, demo_joint) < bound_mrad


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_a_fifth_more_or_less_friction(demo_joint: AxisModel, scale: float) -> None:
    joint = with_friction(demo_joint, scale)
    assert rms_mrad("demo_local", joint) < 0.3
    assert rms_mrad("demo_local_stiff", joint) < 0.05


def test_both_readings_of_table_1(table1_joint: AxisModel) -> None:
    assert rms_mrad("table1_kz_kv_kx", table1_joint) < 0.15
    assert rms_mrad("table1_kx_kv_kz", table1_joint) == pytest.approx(41.0, abs=3.0)


def test_the_papers_lugre_needs_its_friction_to_be_the_joints(table1_joint: AxisModel, demo_joint: AxisModel) -> None:
    assert rms_mrad("paper_pd_lugre", table1_joint) < 1.0
    assert rms_mrad("paper_pd_lugre", demo_joint) > 3.0


@pytest.mark.parametrize("delay_s", [0.0, 0.002])
def test_demo_local_stands_a_cycle_more_or_less_of_delay(demo_joint: AxisModel, delay_s: float) -> None:
    assert rms_mrad("demo_local", demo_joint, LoopSettings(torque_limit_nm=0.5, delay_s=delay_s)) < 0.15


@pytest.mark.parametrize("name", ["demo_pd_dob", "demo_pd_lugre", "demo_local", "demo_local_stiff"])
@pytest.mark.parametrize("amplitude_rad", [0.01, 0.1])
def test_a_step_comes_to_rest_without_chatter_or_creep(demo_joint: AxisModel, name: str, amplitude_rad: float) -> None:
    reference = np.zeros((12_000, 3))
    reference[100:, 0] = amplitude_rad
    result = run(name, demo_joint, reference)
    at_rest = slice(8000, None)
    assert np.ptp(result.position_rad[at_rest]) < 2e-5  # three counts of the encoder
    assert abs(result.position_rad[-1] - amplitude_rad) < 2e-4
    assert np.abs(np.diff(result.torque_nm[at_rest])).max() < 0.005


@pytest.mark.parametrize("name", ["demo_local", "demo_local_stiff"])
def test_a_torque_limit_that_bites_leaves_no_windup(demo_joint: AxisModel, name: str) -> None:
    reference = np.zeros((6000, 3))
    reference[100:3000, 0] = 0.5
    result = run(name, demo_joint, reference, LoopSettings(torque_limit_nm=0.09))
    assert result.torque_nm.max() == pytest.approx(0.09)
    assert result.position_rad.max() < 0.55
    assert abs(result.position_rad[-1]) < 1e-3
