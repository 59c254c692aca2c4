"""The kernels as programs: compiled equals pure Python, an independent solver agrees, nothing ever blows up."""

from __future__ import annotations

import math
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import LAWS
from servod.kernels.laws.state import LawState
from servod.kernels.physics.compiled import bound, compiled
from servod.kernels.physics.layout import PlantState
from servod.kernels.physics.plant import Plant
from servod.lab.simulate.simulate import LoopSettings, run, simulate_closed_loop
from tests.kernels.physics.models import LUGRE, joint, plant

EVERYTHING: dict[str, Any] = {
    "friction": LUGRE,
    "gravity": {"amplitude": 0.02, "phase": 0.4},
    "torque_offset": 0.002,
    "asymmetry": {"positive_dry": 1.1, "negative_viscous": 0.8},
    "stribeck": {"exponent": 1.3},
    "presliding": {"damping_velocity": 0.5},
    "viscous_nonlinear": {"quadratic": 0.002, "cubic": 1e-4, "power": 0.003, "exponent": 0.6},
    "load_dependent_friction": {"per_command": 0.05, "per_load": 0.1},
    "position_dependent_friction": {
        "harmonics": [{"amplitude": 0.2, "periods_per_turn": 3}],
        "bumps": [{"position": 0.1, "width": 0.05, "factor": 0.4}],
    },
    "cogging": {"harmonics": [{"amplitude": 0.003, "periods_per_turn": 17, "phase": 1.0}]},
    "torque_ripple": {"harmonics": [{"amplitude": 0.05, "periods_per_turn": 6}]},
    "spring": {"stiffness": 0.05, "rest": 0.1, "cubic": 0.02},
    "backlash": {"gap": 0.001},
    "joint_elasticity": {
        "load_inertia": 0.0003,
        "stiffness": 40.0,
        "damping": 0.01,
        "load_viscous": 0.005,
        "cubic": 9.0,
    },
    "torque_gain": {"factor": 0.95},
    "torque_saturation": {"limit": 0.2, "shape": "tanh"},
    "delay": {"additional_s": 0.00123},
    "actuator_lag": {"time_constant_s": 0.002, "slew_per_s": 50.0},
    "thermal": {"dry_per_c": -0.01, "viscous_per_c": -0.02, "heating_c_per_j": 3.0, "dry_per_s": 0.01},
    "position_dependent_inertia": {"harmonics": [{"amplitude": 0.2, "periods_per_turn": 2}]},
    "encoder_eccentricity": {"harmonics": [{"amplitude": 0.001, "periods_per_turn": 1}]},
    "disturbance": {"windows": [{"start_s": 0.1, "end_s": 0.2, "torque": 0.02, "frequency_hz": 7.0}]},
    "offset_drift": {"per_s": 0.01, "time_s": 0.2},
    "residual": {"velocity": {"grid": [-1.0, 0.0, 1.0], "torque": [0.0, 0.002, -0.001]}},
    "noise": {"torque_rms": 0.001, "encoder_rms": 1e-5},
}


def everything() -> AxisModel:
    return AxisModel.model_validate({"inertia": 0.001, "delay_s": 0.001, **EVERYTHING})


@pytest.mark.parametrize("model", [joint(delay_s=0.001), everything()], ids=["plain", "everything"])
def test_compiled_is_pure_python(model: AxisModel) -> None:
    """The machine code gives the motion of the source, to the last bits."""
    fast, slow = Plant(model, 3, compile_kernel=True), Plant(model, 3, compile_kernel=False)
    for k in range(400):
        torque = 0.1 * math.sin(0.05 * k)
        fast.advance(torque, 1e-3)
        slow.advance(torque, 1e-3)
        assert fast.encoder_position_rad == pytest.approx(slow.encoder_position_rad, rel=1e-9, abs=1e-12)
        assert fast.motor_velocity_rad_s == pytest.approx(slow.motor_velocity_rad_s, rel=1e-7, abs=1e-10)


@pytest.mark.parametrize("compile_kernel", [False, True])
def test_a_delay_of_the_plants_own_stands_for_the_models(compile_kernel: bool) -> None:
    whole, part, plain = (
        Plant(joint(delay_s=model_s), 3, delay_s=own_s, compile_kernel=compile_kernel)
        for model_s, own_s in ((0.003, 0.00112), (0.00112, None), (0.003, None))
    )
    for k in range(200):
        for axis in (whole, part, plain):
            axis.advance(0.1 * math.sin(0.05 * k), 1e-3)
        assert whole.encoder_position_rad == part.encoder_position_rad == part.motor_position_rad
    assert plain.encoder_position_rad != part.encoder_position_rad


DRY = {"coulomb": 0.045, "viscous": 0.056}
FRICTIONS: dict[str, dict[str, Any]] = {
    "lugre": LUGRE,
    "coulomb_viscous": {"kind": "coulomb_viscous", **DRY},
    "stribeck": {"kind": "stribeck", **DRY, "static": 0.07, "stribeck_velocity": 0.1},
    "local": {
        **{"kind": "local", "sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056},
        **{"velocities": (-2.0, -0.01, 0.01, 2.0), "torques": (-0.16, -0.07, 0.07, 0.16)},
    },
}

#: Groups that a kind of friction refuses (`stribeck` of a map), or takes in another form.
OTHERWISE: dict[str, dict[str, Any]] = {
    "local": {"stribeck": None},
    "coulomb_viscous": {"presliding": {"sigma0": 900.0, "sigma1": 1.0}, "stribeck": {"static": 0.07}},
    "stribeck": {"presliding": {"sigma0": 900.0, "sigma1": 1.0}},
}


@pytest.mark.parametrize("kind", FRICTIONS)
def test_every_group_of_keys_does_something(kind: str) -> None:
    """Leaving any one group out changes the motion, whatever the friction law: no key is read and forgotten."""

    def motion(groups: dict[str, Any]) -> tuple[float, float]:
        axis = Plant(AxisModel.model_validate({"inertia": 0.001, **groups}), 3)
        for k in range(300):
            axis.advance(0.15 * math.sin(0.05 * k), 1e-3)
        return axis.encoder_position_rad, axis.temperature_c

    groups = {**EVERYTHING, **OTHERWISE.get(kind, {}), "friction": FRICTIONS[kind]}
    whole = motion(groups)
    for left_out in {key for key, value in groups.items() if value is not None} - {"friction"}:
        assert motion({key: value for key, value in groups.items() if key not in _with(left_out)}) != whole, left_out


def _with(group: str) -> tuple[str, ...]:
    """A group and those that cannot stand without it: a gap here has its load from the elastic joint."""
    return (group, "backlash") if group == "joint_elasticity" else (group,)


def test_stiff_solver_agrees() -> None:
    """scipy's Radau on the printed equations of LuGre, sliding, sticking and reversing, to a part in a hundred."""
    axis = plant(joint(gravity={"amplitude": 0.03}))

    def right_side(t: float, y: np.ndarray) -> list[float]:
        x, v, z = y
        torque = 0.11 * math.sin(2.0 * math.pi * 2.0 * t) - 0.03 * math.sin(x)
        dz = v - 950.0 * abs(v) / (0.045 + 0.025 * math.exp(-((v / 0.1) ** 2))) * z
        return [v, (torque - 950.0 * z - 1.0 * dz - 0.056 * v) / 0.001, dz]

    times = np.arange(1, 1001) * 1e-3
    exact = solve_ivp(right_side, (0.0, 1.0), [0.0, 0.0, 0.0], "Radau", times, rtol=1e-8, atol=1e-11, max_step=1e-3)
    positions = []
    for t in times:
        for i in range(20):  # the torque held over each inner step, at its middle
            axis.advance(0.11 * math.sin(2.0 * math.pi * 2.0 * (t - 1e-3 + (i + 0.5) * 5e-5)), 5e-5)
        positions.append(axis.position_rad)
    assert np.max(np.abs(positions - exact.y[0])) < 0.01 * np.max(np.abs(exact.y[0]))


@settings(max_examples=40, deadline=None)
@given(
    inertia=st.floats(1e-5, 5.0),
    sigma0=st.floats(10.0, 1e6),
    sigma1=st.floats(0.0, 50.0),
    dry=st.floats(1e-3, 10.0),
    share=st.floats(0.05, 0.95),
    stiffness=st.floats(0.1, 1e5),
    gap=st.floats(1e-6, 0.1),
    torque=st.floats(-20.0, 20.0),
)
def test_any_axis_stays_finite_and_bounded(
    inertia: float, sigma0: float, sigma1: float, dry: float, share: float, stiffness: float, gap: float, torque: float
) -> None:
    """Whatever the parameters, the motor never gains more speed than the torque's impulse can give."""
    model = AxisModel.model_validate(
        {
            "inertia": inertia,
            "friction": {"kind": "lugre", "sigma0": sigma0, "sigma1": sigma1, "coulomb": dry, "static": 1.5 * dry},
            "backlash": {"gap": gap, "load_inertia": share * inertia, "stiffness": stiffness},
        }
    )
    axis = plant(model)
    for _ in range(10):
        axis.advance(torque, 2e-3)
    lighter = inertia * min(share, 1.0 - share)
    most = 3.0 * abs(torque) * 0.02 / lighter + 1e-6
    assert abs(axis.motor_velocity_rad_s) <= most
    assert abs(axis.velocity_rad_s) <= most


def test_a_span_may_be_no_multiple_of_the_inner_step() -> None:
    """Odd spans add up to the same motion as even ones."""
    even, odd = plant(joint()), plant(joint())
    for _ in range(100):
        even.advance(0.1, 1e-3)
    for k in range(100):
        odd.advance(0.1, 1e-3 + (1.3e-5 if k % 2 else -1.3e-5))
    assert odd.time_s == pytest.approx(even.time_s)
    assert odd.position_rad == pytest.approx(even.position_rad, rel=1e-4)


def reference(duration_s: float) -> np.ndarray:
    t = np.arange(0.0, duration_s, 1e-3)
    w = math.pi
    return np.column_stack([0.05 * np.sin(w * t), 0.05 * w * np.cos(w * t), -0.05 * w * w * np.sin(w * t)])


def test_closed_loop_is_the_same_loop_in_pure_python() -> None:
    """The compiled simulator is the source around the law that the control loop runs."""
    law, gains, rows = LAWS["pd"], (2.5, 0.12, 0.0), reference(0.3)
    fast = simulate_closed_loop(joint(delay_s=0.001), law, gains, rows, LoopSettings(torque_rate_nm_per_s=2.0))
    from servod.kernels.physics.plant import INNER_STEP_S, delay_line

    out = np.zeros((len(rows), 8))
    pure = bound(run, control_law=law.step)
    model = joint(delay_s=0.001)
    step = 2.0 * math.pi / 2.0**20
    pure(
        *model.pack(),
        PlantState(temperature_c=25.0),
        delay_line(0.001, INNER_STEP_S),
        law.named(gains),
        LawState(),
        rows,
        np.zeros(len(rows)),
        np.zeros(len(rows)),
        out,
        1e-3,
        20,
        0.001,
        step,
        120.0,
        math.inf,
        2.0,
    )
    assert np.allclose(fast.position_rad, out[:, 0], rtol=1e-6, atol=1e-9)
    assert np.allclose(fast.torque_nm, out[:, 4], rtol=1e-5, atol=1e-7)


def test_closed_loop_tracks_limits_and_counts() -> None:
    rows = reference(2.0)
    run_ = simulate_closed_loop(
        joint(delay_s=0.001), LAWS["pd"], (2.5, 0.12, 0.0), rows, LoopSettings(torque_limit_nm=0.05)
    )
    assert np.max(np.abs(run_.torque_nm)) <= 0.05
    slow = LoopSettings(torque_limit_nm=0.05, torque_rate_nm_per_s=1.0)
    slowed = simulate_closed_loop(joint(delay_s=0.001), LAWS["pd"], (2.5, 0.12, 0.0), rows, slow)
    assert np.max(np.abs(np.diff(slowed.torque_nm, prepend=0.0))) == pytest.approx(1e-3)
    assert np.max(np.abs(np.diff(run_.torque_nm, prepend=0.0))) > 2e-3
    counts = run_.encoder_rad / (2.0 * math.pi / 2.0**20)
    assert np.allclose(counts, np.round(counts), atol=1e-6)
    free = simulate_closed_loop(joint(delay_s=0.001), LAWS["pd"], (2.5, 0.12, 0.0), rows)
    assert 0.005 < np.sqrt(np.mean(free.tracking_error_rad(1.0) ** 2)) < 0.04


def test_another_installation_of_the_same_source_is_not_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for place, hits in (("here", 0), ("there", 1)):
        file = tmp_path / place / "doubling.py"
        file.parent.mkdir()
        file.write_text("def doubled(x):\n    return 2.0 * x\n")
        kernel = compiled(runpy.run_path(str(file))["doubled"])
        assert kernel(2.0) == 4.0
        assert sum(kernel.stats.cache_hits.values()) == hits
