"""The reckoning of a stop against a joint that is moved step by step: what is allowed stays inside, little is lost."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.kernels.stopping import StopFacts, Way, both_ways

STEPS = 1500
LIGHT = StopFacts(1e-3, 1.2e-3, 0.005, 0.0, 0.0, 0.0, 0.3, 3.0, 3.45, -0.6, 0.6, 0.024, 0.006, 200.0)


def stopped(way: Way, torque_nm: float, speed_rad_s: float, inertia: float) -> tuple[float, float]:
    """(highest speed, furthest way) of a joint that keeps `torque_nm` for the reaction and brakes by the ramp then.

    The load pushes all the time, and is what the torque of the ramp has to do with, as is the drive's lag.
    """
    facts, v, x, fastest, furthest = way.facts, speed_rad_s, 0.0, abs(speed_rad_s), 0.0
    dt_s = facts.hold_s / STEPS
    for _ in range(STEPS):
        free = torque_nm + way.push_nm - facts.viscous * v
        dry = math.copysign(facts.friction_nm, v) if v else max(-facts.friction_nm, min(facts.friction_nm, free))
        before, v = v, v + (free - dry) / inertia * dt_s
        if before * v < 0.0:  # friction turns where the joint does, not a step later
            driven_nm = max(0.0, abs(torque_nm + way.push_nm) - facts.friction_nm)
            v = math.copysign(driven_nm, v) / inertia * dt_s * v / (v - before)
        x += 0.5 * (before + v) * dt_s
        fastest, furthest = max(fastest, abs(v)), max(furthest, x)
    if v > 0.0:
        furthest = max(furthest, x + v * facts.lag_s + v * v / (2.0 * way.deceleration_rad_s2))
    return fastest, furthest


FACTS = st.builds(
    LIGHT._replace,
    least_inertia=st.floats(1e-4, 1e-2),
    friction_nm=st.floats(0.0, 0.05),
    viscous=st.sampled_from([0.0, 1e-4, 1e-3, 0.05]),
    load_max_nm=st.sampled_from([0.0, 0.02]),
    load_min_nm=st.sampled_from([0.0, -0.02]),
    hold_s=st.floats(0.005, 0.16),
    deceleration_rad_s2=st.floats(5.0, 2000.0),
)


@given(FACTS, st.floats(-1.0, 1.0), st.floats(0.0, 1.0), st.integers(0, 1))
def test_the_torque_that_is_allowed_keeps_speed_and_room(
    facts: StopFacts, speed_share: float, place: float, which: int
) -> None:
    way = both_ways(facts)[which]
    speed_rad_s, room_rad = speed_share * facts.speed_rad_s, place * 1.2
    torque_nm = way.most_torque_nm(speed_rad_s, room_rad)
    if way.too_near(speed_rad_s, room_rad) or way.unpowered_rad_s(max(speed_rad_s, 0.0)) > facts.top_rad_s:
        return  # the loop stops the joint by now
    if way.end_speed_rad_s(room_rad, speed_rad_s) < way.unpowered_rad_s(0.0) and speed_rad_s <= 0.0:
        return  # it rests where the load alone drives it out: a brake's work
    fastest, furthest = stopped(way, torque_nm, speed_rad_s, facts.least_inertia)
    assert fastest <= facts.top_rad_s * (1.0 + 1e-3)
    assert furthest <= room_rad * (1.0 + 1e-3) + 1e-4


@pytest.mark.parametrize("viscous", [0.0, 0.01])
@pytest.mark.parametrize("room_rad", [0.1, 10.0])
def test_little_is_lost(viscous: float, room_rad: float) -> None:
    way = both_ways(LIGHT._replace(viscous=viscous))[0]
    for speed_rad_s in (0.0, 1.0):
        more_nm = 1.02 * way.most_torque_nm(speed_rad_s, room_rad) + 1e-4
        fastest, furthest = stopped(way, more_nm, speed_rad_s, LIGHT.least_inertia)
        assert fastest > LIGHT.top_rad_s or furthest > room_rad


def test_too_near_is_where_a_joint_without_torque_just_rests_at_the_end() -> None:
    way = both_ways(LIGHT)[0]
    room_rad = way.travel_rad(2.0, 2.0)
    assert not way.too_near(2.0, room_rad * 1.0001)
    assert way.too_near(2.0, room_rad * 0.9999)
    assert not way.too_near(-2.0, 0.0)
    assert not way.too_near(0.0, -1.0)  # at rest outside: the range itself judges


def test_a_load_counts_where_it_pushes() -> None:
    up, down = both_ways(LIGHT._replace(load_min_nm=-0.05))
    assert up.most_torque_nm(0.0, 9.0) - down.most_torque_nm(0.0, 9.0) == pytest.approx(0.05)
    assert math.isfinite(up.coasting_rad(3.0))
    assert math.isinf(down.coasting_rad(3.0))
    assert down.most_speed_rad_s(3.0) < 3.0 == up.most_speed_rad_s(3.0)
    assert down.unpowered_rad_s(down.most_speed_rad_s(3.0)) == pytest.approx(3.0)


def test_a_light_joint_gets_torque_by_what_it_may_gain() -> None:
    """The figures by hand: m*dv = (T - dry)*t."""
    way = Way(LIGHT, 0.0)
    assert way.most_torque_nm(0.0, 1e9) == pytest.approx(0.005 + 1e-3 * 3.45 / 0.024)
    assert way.most_torque_nm(3.0, 1e9) == pytest.approx(0.005 + 1e-3 * 0.45 / 0.024)
    assert way.travel_rad(3.0, 3.45) == pytest.approx(0.012 * 6.45 + 0.006 * 3.45 + 3.45**2 / 400.0)
    assert way.coasting_rad(3.0) == pytest.approx(1.2e-3 * 9.0 / 0.01)
