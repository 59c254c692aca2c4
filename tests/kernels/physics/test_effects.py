"""Every effect of the axis model as physics: periods, resonances, gaps, limits, lags, heat."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.kernels.physics.models import g, joint, period_s, plant, smooth, states

SLIDER = {"inertia": 1e9}  # so heavy that it keeps its velocity: friction can be read off


def sliding_friction(velocity: float, position: float = 0.0, torque: float = 0.0, **groups: object) -> float:
    axis = plant(joint(**SLIDER, **groups))
    axis.place(position, velocity)
    axis.advance(torque, 0.01 / abs(velocity))
    return axis.friction_nm


def test_pendulum_has_the_period_of_its_amplitude() -> None:
    """T = 2*pi*sqrt(J/mgl)*(1 + theta^2/16 + 11 theta^4/3072): the series of the free pendulum."""
    axis = plant(smooth(gravity={"amplitude": 0.1}))
    axis.place(0.6)
    swing = states(axis, 0.0, 6.0)[:, 0]
    exact = 2.0 * math.pi * math.sqrt(0.001 / 0.1) * (1.0 + 0.6**2 / 16.0 + 11.0 * 0.6**4 / 3072.0)
    assert period_s(swing, 1e-3) == pytest.approx(exact, rel=1e-3)


def test_gravity_resists_with_its_phase() -> None:
    axis = plant(smooth(gravity={"amplitude": 0.1, "phase": 0.5}))
    axis.advance(0.0, 1e-3)
    assert axis.velocity_rad_s == pytest.approx(-0.1 * math.sin(0.5) / 0.001 * 1e-3, rel=1e-3)


def test_spring_oscillates_and_stiffens() -> None:
    """omega = sqrt(k/J); with the cubic part it depends on amplitude: omega^2 = (k + 3/4*c*A^2)/J to first order."""
    linear = plant(smooth(spring={"stiffness": 0.4, "rest": 0.1}))
    linear.place(0.3)
    assert period_s(states(linear, 0.0, 3.0)[:, 0] - 0.1, 1e-3) == pytest.approx(2.0 * math.pi / 20.0, rel=1e-3)
    stiffening = plant(smooth(spring={"stiffness": 0.4, "cubic": 2.0}))
    stiffening.place(0.1)
    omega = math.sqrt((0.4 + 0.75 * 2.0 * 0.01) / 0.001)
    assert period_s(states(stiffening, 0.0, 3.0)[:, 0], 1e-3) == pytest.approx(2.0 * math.pi / omega, rel=2e-3)


def test_two_masses_resonate_and_keep_momentum() -> None:
    """omega = sqrt(k*(1/J_m + 1/J_l)); the centre of mass stays; the spring adds no numerical damping."""
    axis = plant(smooth(joint_elasticity={"load_inertia": 0.0004, "stiffness": 3.0}))
    axis._s.position, axis._s.load_position = 0.02, -0.03
    rows = states(axis, 0.0, 2.0)
    stretch = rows[:, 0] - rows[:, 3]
    assert period_s(stretch, 1e-3) == pytest.approx(
        2.0 * math.pi / math.sqrt(3.0 * (1 / 0.0006 + 1 / 0.0004)), rel=1e-3
    )
    assert np.max(np.abs(stretch[-200:])) == pytest.approx(0.05, rel=0.01)
    assert np.allclose(0.0006 * rows[:, 0] + 0.0004 * rows[:, 3], 0.0, atol=1e-9)


def test_stiff_joint_moves_as_one_mass() -> None:
    """With a stiff, damped spring the two masses accelerate as their sum does: the keys are shares of the whole."""
    axis = plant(smooth(joint_elasticity={"load_inertia": 0.0004, "stiffness": 500.0, "damping": 0.05}))
    assert states(axis, 0.01, 0.1)[-1, 1] == pytest.approx(0.01 / 0.001 * 0.1, rel=1e-3)


def test_load_waits_for_the_gap() -> None:
    """Inside the gap the motor moves alone with its own inertia; the load sets off when half the width is used."""
    axis = plant(smooth(backlash={"gap": 0.02, "load_inertia": 0.0004, "stiffness": 500.0, "damping": 0.1}))
    rows = states(axis, 0.01, 0.05)
    contact = math.sqrt(2.0 * 0.01 * 0.0006 / 0.01)
    before = rows[: int(contact / 1e-3) - 1]
    assert np.all(before[:, 3] == 0.0)
    assert before[-1, 1] == pytest.approx(0.01 / 0.0006 * len(before) * 1e-3, rel=1e-9)
    squeezed = 0.577 * math.sqrt(0.00024 / 500.0)  # the speed at contact turned into spring energy
    assert 0.01 < np.max(rows[:, 0] - rows[:, 3]) < 0.01 + squeezed
    assert rows[-1, 3] > 0.0


def test_cogging_is_periodic_and_does_no_work_over_a_turn() -> None:
    harmonics = [{"amplitude": 0.02, "periods_per_turn": 7, "phase": 0.3}]
    axis = plant(smooth(cogging={"harmonics": harmonics}))
    axis.place(0.0, 5.0)
    while axis.position_rad < 2.0 * math.pi:
        axis.advance(0.0, 5e-5)
    potential = 0.02 / 7.0 * (math.cos(0.3) - math.cos(7.0 * axis.position_rad + 0.3))
    energy = 0.5 * 0.001 * axis.velocity_rad_s**2
    assert energy == pytest.approx(0.5 * 0.001 * 25.0 - potential, rel=2e-3)


def test_torque_ripple_scales_with_the_command() -> None:
    groups = {"torque_ripple": {"harmonics": [{"amplitude": 0.2, "periods_per_turn": 4, "phase": math.pi / 2}]}}
    for torque in (0.01, -0.03):
        axis = plant(smooth(**groups))
        axis.advance(torque, 1e-3)
        assert axis.velocity_rad_s == pytest.approx(1.2 * torque / 0.001 * 1e-3, rel=1e-4)


def test_position_dependent_inertia_keeps_energy() -> None:
    """Coasting over a varying inertia, M(x)*v^2/2 stays: the term dM/dx*v^2/2 is there."""
    groups = {"position_dependent_inertia": {"harmonics": [{"amplitude": 0.5, "periods_per_turn": 1}]}}
    axis = plant(smooth(**groups))
    axis.place(0.0, 3.0)
    for _ in range(5):
        axis.advance(0.0, 0.3)
        inertia = 0.001 * (1.0 + 0.5 * math.sin(axis.position_rad))
        assert inertia * axis.velocity_rad_s**2 == pytest.approx(0.001 * 9.0, rel=2e-3)


def test_gain_limit_and_offset() -> None:
    """The limit acts behind the gain, per direction; the offset acts beside and with the command's sign."""
    groups = {
        "torque_gain": {"factor": 0.9, "negative_factor": 1.1},
        "torque_saturation": {"limit": 0.05, "negative_limit": 0.03},
        "torque_offset": 0.004,
    }
    for command, torque in ((0.01, 0.013), (-0.01, -0.007), (1.0, 0.054), (-1.0, -0.026)):
        axis = plant(smooth(**groups))
        axis.advance(command, 0.01)
        assert axis.velocity_rad_s == pytest.approx(torque / 0.001 * 0.01, rel=1e-9)
    soft = plant(smooth(torque_saturation={"limit": 0.05, "shape": "tanh"}))
    soft.advance(0.05, 0.01)
    assert soft.velocity_rad_s == pytest.approx(0.05 * math.tanh(1.0) / 0.001 * 0.01, rel=1e-9)


def test_actuator_lag_and_slew() -> None:
    lag = plant(smooth(actuator_lag={"time_constant_s": 0.01}))
    lag.advance(0.02, 0.01)
    assert lag._s.torque == pytest.approx(0.02 * (1.0 - math.exp(-1.0)), rel=1e-9)
    slew = plant(smooth(actuator_lag={"slew_per_s": 0.5}))
    slew.advance(1.0, 0.01)
    assert slew._s.torque == pytest.approx(0.005, rel=1e-9)


def test_friction_by_load_and_position() -> None:
    plain = g(0.3) + 0.056 * 0.3
    carried = sliding_friction(0.3, torque=0.2, load_dependent_friction={"per_command": 0.1})
    assert carried == pytest.approx(plain + 0.02, rel=1e-3)
    hanging = sliding_friction(
        0.3, -0.01 + math.pi / 2, load_dependent_friction={"per_load": 0.1}, gravity={"amplitude": 0.5}
    )
    assert hanging == pytest.approx(plain + 0.05, rel=1e-3)
    tight = sliding_friction(
        0.3, 0.99, position_dependent_friction={"bumps": [{"position": 1.0, "width": 0.2, "factor": 0.5}]}
    )
    assert tight == pytest.approx(plain + 0.5 * g(0.3), rel=1e-3)
    wavy = sliding_friction(
        0.3, 0.99, position_dependent_friction={"harmonics": [{"amplitude": 0.3, "periods_per_turn": 2}]}
    )
    assert wavy == pytest.approx(plain + 0.3 * math.sin(2.0) * g(0.3), rel=2e-3)


def test_stribeck_and_viscous_shapes() -> None:
    exponent = sliding_friction(0.05, stribeck={"static": 0.09, "stribeck_velocity": 0.2, "exponent": 1.0})
    assert exponent == pytest.approx(0.045 + 0.045 * math.exp(-0.25) + 0.056 * 0.05, rel=1e-4)
    churning = sliding_friction(-2.0, viscous_nonlinear={"quadratic": 0.01, "cubic": 0.001})
    assert churning == pytest.approx(-(0.045 + 0.112 + 0.04 + 0.008), rel=1e-4)
    thinning = sliding_friction(2.0, viscous_nonlinear={"power": 0.02, "exponent": 0.5})
    assert thinning == pytest.approx(0.045 + 0.112 + 0.02 * math.sqrt(2.0), rel=1e-4)


def test_a_map_holds_the_friction_of_both_sides_of_a_joint() -> None:
    """Sliding steadily, motor and load together resist with what the map says, however viscous friction is shared."""
    law = {"kind": "local", "sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056}
    points = {"velocities": (-0.5, -0.01, 0.01, 0.5), "torques": (-0.07, -0.07, 0.07, 0.07)}
    for behind in (0.0, 0.03):
        elastic = {"load_inertia": 5e8, "stiffness": 1e9, "load_viscous": behind}
        motor = sliding_friction(0.3, friction={**law, **points}, joint_elasticity=elastic)
        assert motor + behind * 0.3 == pytest.approx(0.07, rel=1e-6)


@pytest.mark.parametrize("shape, factor", [("linear", 0.9), ("exponential", math.exp(-0.1))])
def test_friction_follows_temperature(shape: str, factor: float) -> None:
    thermal = {"dry_per_c": -0.01, "viscous_per_c": -0.01, "reference_c": 25.0, "shape": shape, "ambient_c": 35.0}
    warm = sliding_friction(0.3, thermal=thermal, noise={"temperature_c": 35.0})
    assert warm == pytest.approx(factor * (g(0.3) + 0.056 * 0.3), rel=1e-4)


def test_friction_warms_the_joint_and_the_joint_cools() -> None:
    """All the work that friction takes becomes heat; without work the joint goes back to ambient."""
    thermal = {"heating_c_per_j": 2.0, "cooling_s": 1e9}
    axis = plant(joint(friction={"kind": "coulomb_viscous", "coulomb": 0.05, "viscous": 0.01}, thermal=thermal))
    axis.place(0.0, 10.0)
    for _ in range(2000):
        axis.advance(0.0, 1e-3)
    assert axis.velocity_rad_s == 0.0
    assert axis.temperature_c == pytest.approx(25.0 + 2.0 * 0.5 * 0.001 * 100.0, rel=5e-4)
    cooling = plant(joint(thermal={"cooling_s": 2.0, "ambient_c": 20.0}, noise={"temperature_c": 60.0}))
    cooling.advance(0.0, 2.0)
    assert cooling.temperature_c == pytest.approx(20.0 + 40.0 * math.exp(-1.0), rel=1e-6)


def test_friction_drifts_with_time() -> None:
    axis = plant(joint(**SLIDER, thermal={"dry_per_s": 0.1, "drift_time_s": 2.0}))
    axis.place(0.0, 0.3)
    for _ in range(200):
        axis.advance(0.0, 0.01)
    factor = 1.0 + 0.1 * 2.0 * (1.0 - math.exp(-1.0))
    assert axis.friction_nm == pytest.approx(factor * g(0.3) + 0.056 * 0.3, rel=1e-3)


@pytest.mark.parametrize(
    ("ends", "speed"),
    [({}, 0.5 * 0.02 * 0.5**2), ({"time_s": 0.1}, 0.02 * 0.1 * (0.5 - 0.1 * (1.0 - math.exp(-5.0))))],
)
@pytest.mark.parametrize("more", [{}, {"spring": {"stiffness": 0.0}}], ids=["plain", "general"])
def test_an_offset_drifts_with_time(ends: dict[str, float], speed: float, more: dict[str, Any]) -> None:
    """A free axis of 0.001 kg*m^2 gets the integral of the torque, in either loop."""
    axis = plant(smooth(offset_drift={"per_s": 0.02, **ends}, **more))
    rows = states(axis, 0.0, 0.5)
    assert rows[-1, 1] == pytest.approx(speed / 0.001, rel=5e-3)


def test_disturbance_acts_in_its_window_only() -> None:
    windows = [{"start_s": 0.1, "end_s": 0.3, "torque": 0.01}]
    axis = plant(smooth(disturbance={"windows": windows}))
    rows = states(axis, 0.0, 0.5)
    assert rows[98, 1] == 0.0
    assert rows[-1, 1] == pytest.approx(0.01 / 0.001 * 0.2, rel=1e-3)
    assert rows[-1, 1] == pytest.approx(rows[310, 1], rel=1e-8)


def test_residual_tables_act_over_their_grid() -> None:
    table = {"grid": [-1.0, 0.0, 1.0], "torque": [0.0, 0.01, 0.0]}
    for place, torque in ((0.0, 0.01), (0.5, 0.005), (1.5, 0.0)):
        axis = plant(smooth(residual={"position": table}))
        axis.place(place)
        axis.advance(0.0, 1e-3)
        assert axis.velocity_rad_s == pytest.approx(-torque / 0.001 * 1e-3, rel=1e-3)


def test_eccentric_encoder_shows_what_is_not_there() -> None:
    groups = {"encoder_eccentricity": {"harmonics": [{"amplitude": 0.003, "periods_per_turn": 1, "phase": 0.2}]}}
    axis = plant(smooth(**groups))
    axis.place(1.0)
    axis.advance(0.0, 0.0)
    assert axis.encoder_position_rad == pytest.approx(1.0 + 0.003 * math.sin(1.2))
    assert axis.position_rad == 1.0


def test_noise_is_seeded_and_has_its_size() -> None:
    noise = {"torque_rms": 0.01, "torque_bandwidth_hz": 50.0, "encoder_rms": 1e-4}
    torques, readings = [], []
    from servod.kernels.physics.plant import Plant

    for seed in (1, 1, 2):
        axis = Plant(joint(**SLIDER, noise=noise), seed, compile_kernel=False)
        torques.append([])
        readings.append([])
        for _ in range(3000):
            axis.advance(0.0, 1e-3)
            torques[-1].append(axis._noise_torque_nm)
            readings[-1].append(axis.encoder_position_rad)
    assert torques[0] == torques[1] != torques[2]
    assert np.std(torques[0]) == pytest.approx(0.01, rel=0.15)
    assert np.std(readings[0]) == pytest.approx(1e-4, rel=0.1)
