"""The LuGre bristle as physics: steady friction, presliding, breakaway, passivity, stability at any step."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.kernels.physics.friction import bristle_step, coulomb_step, stribeck_curve
from servod.kernels.physics.plant import INNER_STEP_S, delay_line
from tests.kernels.physics.models import g, joint, plant, states


@pytest.mark.parametrize("velocity", [0.002, -0.002, 0.05, -0.05, 0.3, -1.0])
def test_steady_sliding_carries_the_stribeck_curve(velocity: float) -> None:
    """A joint so heavy that its velocity stays shows F = g(v)*sign(v) + F_v*v once the bristle has settled."""
    axis = plant(joint(inertia=1e9))
    axis.place(0.0, velocity)
    axis.advance(0.0, 0.5)
    assert axis.friction_nm == pytest.approx(math.copysign(g(velocity), velocity) + 0.056 * velocity, rel=1e-4)


def test_presliding_stiffness_is_sigma0() -> None:
    """A torque far under breakaway bends the bristle like a spring of stiffness sigma0 and is given back."""
    axis = plant(joint())
    bent = states(axis, 0.0007, 0.02)[-1, 0]
    assert bent == pytest.approx(0.0007 / 950.0, rel=0.02)
    assert abs(states(axis, 0.0, 0.02)[-1, 0]) < 0.03 * bent


@pytest.mark.parametrize("share, slides", [(0.97, False), (1.03, True)])
def test_breakaway_is_at_static_friction(share: float, slides: bool) -> None:
    """A torque that creeps up breaks the joint away at F_S and not before."""
    axis = plant(joint())
    for k in range(2000):
        axis.advance(share * 0.07 * k / 2000.0, 1e-3)
    axis.advance(share * 0.07, 0.2)
    assert (abs(axis.position_rad) > 0.005) == slides


def test_hysteresis_loop_loses_energy() -> None:
    """A closed cycle of torque under breakaway takes work from the source: presliding is lossy, never a source."""
    axis = plant(joint())
    work = 0.0
    for k in range(4000):
        torque = 0.05 * math.sin(2.0 * math.pi * k / 1000.0)
        before = axis.position_rad
        axis.advance(torque, 1e-3)
        work += torque * (axis.position_rad - before) if k >= 1000 else 0.0
    assert work > 0.0


numbers = st.floats(-1.0, 1.0)


@settings(max_examples=150, deadline=None)
@given(
    velocity=st.floats(-20.0, 20.0),
    share=numbers,
    torque=st.floats(-5.0, 5.0),
    inertia=st.floats(1e-5, 10.0),
    h=st.floats(1e-6, 0.1),
    dry=st.floats(1e-4, 10.0),
    sigma0=st.floats(1.0, 1e6),
    sigma1=st.floats(0.0, 100.0),
)
def test_bristle_step_is_passive_at_any_step(
    velocity: float, share: float, torque: float, inertia: float, h: float, dry: float, sigma0: float, sigma1: float
) -> None:
    """Up to 4*g/|v| of damping, work done on the joint covers what kinetic and bristle energy gain at any step."""
    sigma1 = min(sigma1, 4.0 * dry / max(abs(velocity), 1e-9))
    bristle = share * dry / sigma0
    v, z, friction = bristle_step(velocity, bristle, torque, inertia, h, dry, sigma0, sigma1, 0.01)
    gained = 0.5 * inertia * (v * v - velocity * velocity) + 0.5 * sigma0 * (z * z - bristle * bristle)
    given_in = torque * v * h
    scale = abs(given_in) + inertia * (v * v + velocity * velocity) + sigma0 * (z * z + bristle * bristle)
    assert gained <= given_in + 1e-9 * scale
    assert inertia * (v - velocity) / h == pytest.approx(torque - friction, rel=1e-5, abs=1e-6 * (1 + inertia / h))


@settings(max_examples=80, deadline=None)
@given(torques=st.lists(st.floats(-3.0, 3.0), min_size=5, max_size=40), h=st.sampled_from([5e-5, 1e-3, 0.05]))
def test_bristle_stays_bounded(torques: list[float], h: float) -> None:
    """The bristle never bends by more than one step's travel beyond F_S/sigma0."""
    v, z = 0.0, 0.0
    p = joint().pack()
    for torque in torques:
        for _ in range(20):
            dry = stribeck_curve(*p, v)
            v, z, _ = bristle_step(v, z, torque, 0.001, h, dry, 950.0, 1.0, 0.056)
            assert math.isfinite(v) and math.isfinite(z)
            assert abs(v) <= 3.0 / 0.056
            assert abs(z) <= 0.07 / 950.0 + h * abs(v)


def test_coulomb_sticks_exactly_and_slides_exactly() -> None:
    """Set-valued friction holds any torque up to F_C without creep, and takes F_C when sliding."""
    assert coulomb_step(0.0, 0.0449, 0.001, 5e-5, 0.045, 0.0) == (0.0, pytest.approx(0.0449))
    v, friction = coulomb_step(1.0, 0.0, 0.001, 5e-5, 0.045, 0.0)
    assert friction == pytest.approx(0.045)
    assert v == pytest.approx(1.0 - 0.045 / 0.001 * 5e-5)


def test_coulomb_stops_in_the_time_that_momentum_gives() -> None:
    """Free decay under Coulomb friction: linear, at rest after m*v/F_C, for good."""
    axis = plant(joint(friction={"kind": "coulomb_viscous", "coulomb": 0.05}))
    axis.place(0.0, 2.0)
    rows = states(axis, 0.0, 0.1)
    assert rows[19, 1] == pytest.approx(1.0, rel=1e-3)
    assert rows[-1, 1] == 0.0
    assert rows[-1, 0] == pytest.approx(0.001 * 4.0 / (2.0 * 0.05), rel=1e-3)


def test_viscous_decay_is_exponential() -> None:
    """Free decay under viscous friction alone: v(t) = v0*exp(-F_v*t/m)."""
    axis = plant(joint(friction={"kind": "coulomb_viscous", "viscous": 0.056}))
    axis.place(0.0, 2.0)
    axis.advance(0.0, 0.02)
    assert axis.velocity_rad_s == pytest.approx(2.0 * math.exp(-0.056 * 0.02 / 0.001), rel=4e-3)


def test_asymmetry_acts_by_direction() -> None:
    """Each direction has its own dry and viscous factor."""
    groups = {"positive_dry": 1.2, "negative_dry": 0.7, "positive_viscous": 1.5, "negative_viscous": 0.5}
    for velocity, dry, viscous in ((0.3, 1.2, 1.5), (-0.3, 0.7, 0.5)):
        axis = plant(joint(inertia=1e9, asymmetry=groups))
        axis.place(0.0, velocity)
        axis.advance(0.0, 0.2)
        assert abs(axis.friction_nm) == pytest.approx(dry * g(0.3) + viscous * 0.056 * 0.3, rel=1e-4)


def test_local_map_is_the_steady_friction() -> None:
    """The local kind slides at the friction of its map, in both directions, between and beyond its sets."""
    friction = {
        **{"kind": "local", "sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056},
        "velocities": [-0.5, -0.1, -0.01, 0.01, 0.1, 0.5],
        "torques": [-0.07, -0.06, -0.08, 0.09, 0.05, 0.075],
    }
    for velocity, torque in ((0.3, 0.0625), (0.1, 0.05), (-0.055, -0.07), (-0.01, -0.08), (2.0, 0.075)):
        axis = plant(joint(inertia=1e9, friction=friction))
        axis.place(0.0, velocity)
        axis.advance(0.0, 0.3)
        beyond = max(0.0, 0.056 * abs(velocity) - 0.99 * abs(torque))
        assert axis.friction_nm == pytest.approx(torque + beyond, rel=1e-3)


def test_delay_line_delays_by_any_time() -> None:
    """A step of torque shows after delay_s, also when that is no multiple of the inner step."""
    for delay in (0.0, 0.001, 0.00333, 0.015):
        axis = plant(joint(friction={"kind": "coulomb_viscous"}, delay_s=delay))
        axis.advance(0.01, 0.05)
        assert axis.velocity_rad_s == pytest.approx(0.01 / 0.001 * (0.05 - delay), rel=1e-9)
        assert len(delay_line(delay, INNER_STEP_S)) == math.ceil(delay / 5e-5 + 1e-9) + 2
