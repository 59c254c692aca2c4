"""The friction-compensating laws: steady state (7), sign of l, asymmetry, anti-windup, rest, NaN."""

from __future__ import annotations

import math
from typing import Any

import pytest

from servod.kernels.laws import LAWS, local
from servod.kernels.laws.state import LawState
from tests.kernels.laws.cases import GAINS, NODES, SIGMA0, VISCOUS, level, local_gains

DT = 0.001


def settle(name: str, p: Any, v: float, seconds: float = 3.0) -> tuple[float, float, float, float]:
    """Run the law at constant velocity without tracking error; its last answer."""
    s = LawState()
    out = (0.0, 0.0, 0.0, 0.0)
    for _ in range(int(seconds / DT)):
        out = LAWS[name].step(p, s, 0.0, v, 0.0, 0.0, v, s.asked, DT)
    return out


@pytest.mark.parametrize("v", [v for v in NODES if v])
def test_local_steady_state_is_equation_7(v: float) -> None:
    p = local_gains()
    friction = settle("local", p, v)[2]
    decay = p.sets.decays[NODES.index(v)]
    assert friction == pytest.approx((SIGMA0 / decay + VISCOUS) * abs(v) * math.copysign(1.0, v), rel=1e-6)
    assert friction == pytest.approx(math.copysign(level(v), v) + VISCOUS * v, rel=1e-6)


@pytest.mark.parametrize("v", [-0.5, 0.5])
def test_local_knows_each_direction_apart(v: float) -> None:
    friction = settle("local", local_gains(asymmetry=0.15), v)[2]
    expected = math.copysign(level(v), v) * (1.0 + math.copysign(0.15, v)) + VISCOUS * v
    assert friction == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("v", [-0.3, -0.01, 0.002, 0.08, 1.0])
def test_lugre_steady_state_is_its_stribeck_curve(v: float) -> None:
    friction = settle("pd_lugre", GAINS["pd_lugre"], v)[2]
    assert friction == pytest.approx(math.copysign(level(v), v) + VISCOUS * v, rel=1e-6)


@pytest.mark.parametrize("error", [-1e-3, 1e-3])
@pytest.mark.parametrize("name", ["local", "pd_lugre"])
def test_l_pushes_the_way_the_feedback_pushes(name: str, error: float) -> None:
    p = local_gains(gain=0.04) if name == "local" else GAINS["pd_lugre"]
    s = LawState()
    _, feedback, friction, _ = LAWS[name].step(p, s, error, 0.0, 0.0, 0.0, 0.0, 0.0, DT)
    assert friction * feedback > 0.0
    rate = s.z_hat / DT
    assert rate == pytest.approx(0.04 * feedback / 0.1, rel=1e-6)  # l*u* with u* = u_feedback/K


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("name", ["local", "pd_lugre"])
def test_no_windup_into_a_limit_and_free_way_out(name: str, sign: float) -> None:
    p = local_gains(gain=0.04) if name == "local" else GAINS["pd_lugre"]
    s = LawState()
    applied = 0.0
    for _ in range(2000):  # blocked joint, torque limited to 20 mN*m
        torque = LAWS[name].step(p, s, sign * 0.02, 0.0, 0.0, 0.0, 0.0, applied, DT)[0]
        applied = sign * min(sign * torque, 0.02)
    wound = sign * s.z_hat
    assert 0.0 < wound <= 1.01 * 0.04 * (2.5 * 0.02 / 0.1) * DT  # l*u* of the one step before the limit
    LAWS[name].step(p, s, -sign * 0.02, 0.0, 0.0, 0.0, 0.0, applied, DT)
    assert sign * s.z_hat < wound


@pytest.mark.parametrize("name", ["local", "pd_lugre"])
def test_friction_state_stays_within_its_bound(name: str) -> None:
    p = local_gains(gain=10.0) if name == "local" else GAINS["pd_lugre"]
    s = LawState()
    for _ in range(5000):
        LAWS[name].step(p, s, 0.5, 0.0, 0.0, 0.0, 0.0, s.asked, DT)
        assert abs(s.z_hat) <= p.state_limit
    assert s.z_hat == p.state_limit


def test_within_the_hold_width_nothing_integrates_and_the_leak_empties_the_state() -> None:
    p = local_gains(gain=0.04, leak=2.0, hold_within=5e-5, bandwidth=50.0)
    s = LawState()
    s.z_hat = 5e-5
    for _ in range(1000):
        LAWS["local"].step(p, s, 4e-5, 0.0, 0.0, 0.0, 0.0, s.asked, DT)
    assert s.z_hat == pytest.approx(5e-5 * math.exp(-2.0), rel=1e-9)
    assert s.d_hat == 0.0


def test_reference_velocity_keeps_encoder_noise_out_of_the_friction_state() -> None:
    quiet, noisy = (local_gains(source=source) for source in (local.REFERENCE, local.MEASURED))
    states = []
    for p in (quiet, noisy):
        s = LawState()
        for k in range(100):
            LAWS["local"].step(p, s, 0.0, 0.0, 0.0, 0.0, 0.004 if k % 2 else -0.004, s.asked, DT)
        states.append(abs(s.z_hat))
    assert states[0] == 0.0 < states[1]


def test_reference_velocity_is_led() -> None:
    p = local_gains(source=local.REFERENCE)._replace(lead=0.002)
    s = LawState()
    LAWS["local"].step(p, s, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, DT)
    assert s.z_hat == pytest.approx(0.001 * DT, rel=0.02)


def driven(p: local.LocalGains, error: float, v_ref: float) -> float:
    """Velocity that drove z_hat in one step from rest [rad/s]; the decay of so short a step is negligible."""
    s = LawState()
    LAWS["local"].step(p._replace(sets=p.sets._replace(decays=(0.0,) * len(p.sets.nodes))), s, error, v_ref, *REST)
    return s.z_hat / DT


REST = (0.0, 0.0, 0.0, 0.0, DT)  # reference acceleration, position, velocity, torque, period


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("beyond_rad", "more"), [(-1e-6, 0.0), (0.0, 0.0), (1e-3, 25.0 / 1.2 * 1e-3), (0.1, 0.5)])
def test_the_corrected_reference_goes_the_way_back_beyond_a_bristles_stretch(
    sign: float, beyond_rad: float, more: float
) -> None:
    p = local_gains(source=local.CORRECTED)
    p = p._replace(leak=0.0, state_limit=1e-3)
    error = sign * (p.state_limit + beyond_rad)
    assert driven(p, error, 0.01) == pytest.approx(0.01 + sign * more)
    assert driven(p._replace(source=local.REFERENCE), error, 0.01) == pytest.approx(0.01)
    assert driven(p, error, 0.0) == pytest.approx(sign * more)  # also back to a reference that rests
    assert driven(p._replace(low_k_v=0.0), error, 0.01) == pytest.approx(0.01)


@pytest.mark.parametrize(("speed", "share"), [(0.0, 0.0), (0.005, 0.0), (0.0125, 0.5), (0.02, 1.0), (0.3, 1.0)])
@pytest.mark.parametrize("moves", ["joint", "reference"])
def test_region_gains_blend_over_the_overlap(speed: float, share: float, moves: str) -> None:
    apart = {"low_k_x": 100.0, "high_k_x": 10.0, "low_k_v": 0.0, "high_k_v": 0.0}
    p = local_gains(source=local.REFERENCE)._replace(**apart)
    v, v_ref = (speed, 0.0) if moves == "joint" else (0.0, speed)
    feedback = LAWS["local"].step(p, LawState(), 0.01, v_ref, 0.0, 0.0, v, 0.0, DT)[1]
    assert feedback == pytest.approx(0.1 * 0.01 * (100.0 + share * (10.0 - 100.0)))


def test_k_z_is_negative_feedback_of_the_friction_state() -> None:
    p = local_gains()._replace(low_k_z=200.0)
    s = LawState()
    s.z_hat = 1e-5
    assert LAWS["local"].step(p, s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, DT)[1] == pytest.approx(-0.1 * 200.0 * 1e-5)


@pytest.mark.parametrize("name", list(LAWS))
@pytest.mark.parametrize("argument", [0, 1, 3, 4])  # x_ref, v_ref, x, v
def test_nan_in_is_nan_out(name: str, argument: int) -> None:
    values = [0.01, 0.02, 0.0, 0.01, 0.02, 0.0, DT]
    values[argument] = math.nan
    x_ref, v_ref, a_ref, x, v, u_applied, dt = values
    torque = LAWS[name].step(GAINS[name], LawState(), x_ref, v_ref, a_ref, x, v, u_applied, dt)[0]
    assert math.isnan(torque)


@pytest.mark.parametrize("name", list(LAWS))
def test_parts_add_up_and_symmetric_laws_are_odd(name: str) -> None:
    answers = []
    for sign in (1.0, -1.0):
        p = local_gains(nodes=(-0.5, -0.05, 0.0, 0.05, 0.5), gain=0.04) if name == "local" else GAINS[name]
        s = LawState()
        for v in (0.01, 0.03, 0.06, -0.02):
            u, feedback, friction, other = LAWS[name].step(
                p, s, sign * 0.01, sign * 0.02, sign * 0.1, 0.0, sign * v, s.asked, DT
            )
            assert u == pytest.approx(feedback + friction + other)
        answers.append(u)
    assert answers[0] == pytest.approx(-answers[1])


@pytest.mark.parametrize("limit_nm", [math.inf, 0.05])
def test_the_last_commands_count_as_the_limits_let_them_through(limit_nm: float) -> None:
    p = local_gains(source=local.REFERENCE, memory=(0.5, 0.25, 0.0))
    s = LawState()
    given: list[float] = [0.0, 0.0]
    for _ in range(5):
        feedback = LAWS["local"].step(p, s, 0.1, 0.0, 0.0, 0.0, 0.0, given[-1], DT)[1]
        assert feedback == pytest.approx(0.25 - 0.5 * given[-1] - 0.25 * given[-2], rel=1e-9)
        given.append(min(feedback, limit_nm))


def test_driven_by_the_reference_the_friction_state_rests_with_it() -> None:
    p = local_gains(source=local.REFERENCE, leak=2.0, hold_within=5e-5)
    s = LawState()
    s.z_hat = 5e-5
    for _ in range(1000):
        LAWS["local"].step(p, s, 4e-5, 0.0, 0.0, 0.0, 0.0, s.asked, DT)
    assert s.z_hat == 5e-5
    LAWS["local"].step(p, s, 6e-5, 0.0, 0.0, 0.0, 0.0, s.asked, DT)
    assert s.z_hat < 5e-5


def test_the_feedback_sees_a_limited_error() -> None:
    p = local_gains(error_limit=0.01)
    for error, seen in ((0.005, 0.005), (0.1, 0.01), (-0.1, -0.01)):
        feedback = LAWS["local"].step(p, LawState(), error, 0.0, 0.0, 0.0, 0.0, 0.0, DT)[1]
        assert feedback == pytest.approx(2.5 * seen)
