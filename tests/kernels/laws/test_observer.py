"""The disturbance observer: rejects a constant torque, does not wind up, and holds at rest."""

from __future__ import annotations

import math
from typing import Any

import pytest

from servod.kernels.laws import LAWS
from servod.kernels.laws.state import LawState
from tests.kernels.laws.cases import GAINS, local_gains

DT, INERTIA, INNER = 0.001, 0.001, 20


class Rotor:
    """An inertia without friction under a constant load; the torque acts one cycle late, as on the bus."""

    def __init__(self, load_nm: float) -> None:
        self.x = self.v = self.pending = 0.0
        self.load_nm = load_nm

    def advance(self, torque: float) -> None:
        """One cycle under the torque of the cycle before."""
        for _ in range(INNER):
            self.v += (self.pending - self.load_nm) / INERTIA * DT / INNER
            self.x += self.v * DT / INNER
        self.pending = torque


def run(name: str, p: Any, load_nm: float, limit_nm: float, seconds: float) -> tuple[Rotor, LawState]:
    rotor, s, applied = Rotor(load_nm), LawState(), 0.0
    for _ in range(int(seconds / DT)):
        torque = LAWS[name].step(p, s, 0.0, 0.0, 0.0, rotor.x, rotor.v, applied, DT)[0]
        applied = max(-limit_nm, min(limit_nm, torque))
        rotor.advance(applied)
    return rotor, s


@pytest.mark.parametrize("load_nm", [-0.03, 0.02])
def test_rejects_a_constant_disturbance(load_nm: float) -> None:
    with_observer, s = run("pd_dob", GAINS["pd_dob"], load_nm, 1.0, 2.0)
    without, _ = run("pd", GAINS["pd"], load_nm, 1.0, 2.0)
    assert s.d_hat == pytest.approx(load_nm, rel=1e-3)
    assert abs(with_observer.x) < 1e-5
    assert abs(without.x) == pytest.approx(abs(load_nm) / 2.5, rel=1e-2)


def test_the_local_law_has_the_same_observer_as_an_option() -> None:
    p = local_gains(nodes=(-0.5, -0.001, 0.0, 0.001, 0.5), bandwidth=50.0, leak=2.0)
    free = p._replace(stiffness=0.0, viscous=0.0)  # a rotor without friction: nothing to compensate
    rotor, s = run("local", free, 0.02, 1.0, 2.0)
    assert s.d_hat == pytest.approx(0.02, rel=1e-3)
    assert abs(rotor.x) < 1e-5


def test_estimate_does_not_wind_up_behind_a_limit() -> None:
    rotor, s = run("pd_dob", GAINS["pd_dob"], 0.0, 0.001, 0.5)
    assert (rotor.x, s.d_hat) == (0.0, 0.0)
    state, applied = LawState(), 0.0
    for _ in range(2000):  # the reference is far, the joint turns freely under 1 mN*m: nothing disturbs it
        torque = LAWS["pd_dob"].step(GAINS["pd_dob"], state, 1.0, 0.0, 0.0, rotor.x, rotor.v, applied, DT)[0]
        applied = max(-0.001, min(0.001, torque))
        rotor.advance(applied)
        assert abs(state.d_hat) < 1e-9


def test_estimate_is_bounded() -> None:
    _, s = run("pd_dob", GAINS["pd_dob"], 0.5, 1.0, 1.0)
    assert s.d_hat == 0.1


def test_response_is_first_order_with_the_stated_bandwidth() -> None:
    s = LawState()
    law, p = LAWS["pd_dob"], GAINS["pd_dob"]
    for _ in range(2):  # fills the delay of one cycle
        law.step(p, s, 0.0, 1e-9, 0.0, 0.0, 0.0, 0.02, DT)
    begin = s.d_hat
    for _ in range(20):
        law.step(p, s, 0.0, 1e-9, 0.0, 0.0, 0.0, 0.02, DT)
    assert 0.02 - s.d_hat == pytest.approx((0.02 - begin) * math.exp(-50.0 * 20 * DT), rel=1e-9)


def test_estimate_holds_while_the_reference_rests_and_the_error_is_small() -> None:
    p = GAINS["pd_dob"]._replace(hold_within=5e-5)
    s = LawState()
    s.d_hat = 0.01
    for _ in range(100):
        LAWS["pd_dob"].step(p, s, 4e-5, 0.0, 0.0, 0.0, 0.0, 0.03, DT)
    assert s.d_hat == 0.01
    LAWS["pd_dob"].step(p, s, 6e-5, 0.0, 0.0, 0.0, 0.0, 0.03, DT)
    assert s.d_hat > 0.01


def test_nominal_viscous_friction_is_no_disturbance() -> None:
    p = GAINS["pd_dob"]._replace(viscous=0.056)
    s = LawState()
    for _ in range(500):
        LAWS["pd_dob"].step(p, s, 0.0, 0.5, 0.0, 0.0, 0.5, 0.056 * 0.5 + 0.01, DT)
    assert s.d_hat == pytest.approx(0.01, rel=1e-6)
