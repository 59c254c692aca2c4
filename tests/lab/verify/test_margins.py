"""Margins and poles of the full loop: lag, delay interval, corners, what goes by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.effects import ActuatorLag
from servod.lab.verify.checks import CORNER_DISK, Subject, check_loop, observations
from servod.lab.verify.closed_loop import LinearBristle, LoopDeviation, corners, inner_points, joint_point, late_corners
from servod.lab.verify.margins import NOMINAL, Sweep, sensitivity
from servod.lab.verify.plants import drawn
from servod.lab.verify.sampled import SampledTiming
from tests.lab.synthesize.designs import table1, table1_set

CORNER = "symmetric disk margin, worst corner of the intervals"


def subject(model: AxisModel | None = None, **uncertainty: float) -> Subject:
    gains = table1_set()
    assert gains.design is not None
    widths = gains.design.uncertainty.model_copy(update=uncertainty)
    design = gains.design.model_copy(update={"model": model or table1(), "uncertainty": widths})
    return Subject(gains, design, 1, 1, 1)


def lagging(time_constant_s: float) -> AxisModel:
    return table1().model_copy(update={"actuator_lag": ActuatorLag(time_constant_s=time_constant_s)})


def test_a_lag_is_in_the_loop() -> None:
    rigid, slow = subject(), subject(lagging(0.0005))
    assert slow.timing.as_delay.delay_s == pytest.approx(rigid.timing.delay_s + 0.0005)
    assert slow.coarse.disk_margin()[0] < 0.5 * rigid.coarse.disk_margin()[0]
    assert slow.coarse.worst(NOMINAL).coupled_radius > rigid.coarse.worst(NOMINAL).coupled_radius


def test_a_lag_is_a_state_of_the_joint_and_a_delay_in_its_place_is_the_harder_of_both() -> None:
    """The margin is that of a joint put together here with the lag as a fourth state, under the same law."""
    judged, tau = subject(), 0.0004
    sweep = judged.coarse
    late = LoopDeviation(delay_s=tau)
    velocity, slopes = sweep.coupled[12]
    a, b, _ = joint_point(sweep.friction, velocity, LinearBristle.SLIDES, LoopDeviation()).matrices()
    held = np.zeros((5, 5))
    held[:3, :3], held[:3, 3], held[3, 3:] = a, b, (-1.0 / tau, 1.0 / tau)
    step = expm(held * judged.timing.period_s)
    period, kept = judged.timing.period_s, judged.timing.kept
    # states x, v, z, torque, u_(k-1), v_f; one whole cycle of delay before the lag
    assert judged.timing.delay_s == pytest.approx(period)
    plant = np.zeros((6, 6))
    plant[:4, :4], plant[:4, 4] = step[:4, :4], step[:4, 4]
    plant[5] = (1.0 - kept) / period * plant[0]
    plant[5, 0] -= (1.0 - kept) / period
    plant[5, 5] += kept
    keep = [i for i in range(len(slopes.matrix) - 1) if i not in slopes.frozen]
    size = 6 + len(keep)
    seen, columns = [0, 1, *(2 + i for i in keep)], [0, 5, *range(6, size)]
    row, column, closed = np.zeros(size), np.zeros(size), np.zeros((size, size))
    row[columns], column[4], closed[:6, :6] = slopes.matrix[0, seen], 1.0, plant
    closed += np.outer(column, row)
    for j, i in enumerate(keep):
        closed[6 + j, columns] = slopes.matrix[1 + i, seen]
    lag = 1.0 / np.abs(sensitivity(closed[None], column[None], row) - 0.5).max()
    one = Sweep(sweep.law, sweep.gains, sweep.friction, sweep.timing, (abs(velocity),))

    def margin(case: LoopDeviation, timing: SampledTiming) -> float:
        systems = [x for v, _, x in one.systems((case,), timing, transient=False) if v == velocity]
        return min(1.0 / float(np.abs(sensitivity(*system) - 0.5).max()) for system in systems)

    assert margin(LoopDeviation(), replace(judged.timing, lag_s=tau)) == pytest.approx(lag, rel=1e-6)
    assert 0.0 < margin(late, judged.timing) < lag


def test_a_whole_cycle_of_delay_has_the_lag_in_it() -> None:
    """An axis that is late by its lag alone is judged no harder than one that is as late by its delay."""
    slow = lagging(0.0007).model_copy(update={"delay_s": 0.0001})
    judged = subject(slow)
    assert judged.own_cycles == pytest.approx(0.8)
    assert judged.cycles(1.0).as_delay.delay_s == pytest.approx(0.001)
    assert judged.cycles(0.5).delay_s == 0.0
    assert judged.timing.later_by(-0.0002).delay_s == 0.0


def test_the_response_from_poles_is_that_of_the_states() -> None:
    closed, column, row = next(x for v, _, x in subject().coarse.systems(NOMINAL) if v > 0.05)
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 200))
    by_states = [1.0 + row @ np.linalg.solve(w * np.eye(len(row)) - closed[0], column[0]) for w in z]
    assert np.abs(sensitivity(closed, column, row)[0] - by_states).max() < 1e-3 * np.abs(by_states).max()


def test_the_delay_has_an_interval_in_corners_points_and_plants() -> None:
    wide = Uncertainty(delay_s=1e-4)
    assert {corner.delay_s for corner in corners(wide)} == {-1e-4, 1e-4}
    assert {corner.delay_s for corner in late_corners(wide)} == {1e-4}
    assert len({point.delay_s for point in inner_points(wide, 30, 1)}) == 5
    delays = [drawn(table1(), wide, 1, i).total_delay_s for i in range(40)]
    assert 0.0009 <= min(delays) < 0.00093 and 0.00107 < max(delays) <= 0.0011
    late, sharp = subject(delay_s=1e-4), subject(delay_s=0.0)
    assert (
        late.coarse.disk_margin(corners(late.design.uncertainty))[0]
        < 0.8 * sharp.coarse.disk_margin(corners(sharp.design.uncertainty))[0]
    )


def test_the_corners_have_a_disk_margin_of_their_own() -> None:
    checks = {check.name: check for check in check_loop(subject())}
    assert checks[CORNER].passed and CORNER_DISK < checks[CORNER].value < checks["symmetric disk margin"].value
    vague = {check.name: check for check in check_loop(subject(stiffness=0.3, slope=0.5, damping=0.6))}
    assert not vague[CORNER].passed and vague["symmetric disk margin"].passed


def test_the_leak_does_not_hide_the_loops_own_largest_pole() -> None:
    worst = subject().coarse.worst(NOMINAL)
    leak = np.exp(-2.0 * subject().timing.period_s)
    assert worst.radius == pytest.approx(leak, abs=1e-9) or worst.radius == worst.coupled_radius > leak
    assert worst.coupled_radius != pytest.approx(leak, abs=1e-9)
    assert "largest pole, corners, without the leak of z_hat's own" in {check.name for check in check_loop(subject())}


def test_an_axis_of_two_cycles_is_judged_by_its_own_delay_and_says_so() -> None:
    two = subject(table1().model_copy(update={"delay_s": 0.002}))
    names = {check.name for check in check_loop(two)}
    assert "largest pole, the axis's own delay of 2.00 cycles" in names
    assert "largest pole, one cycle of delay" not in names
    assert {"largest pole, one cycle of delay", "largest pole, two cycles of delay"} <= set(observations(two))


def test_a_search_judges_corners_of_different_delays_each_with_its_own() -> None:
    judged = subject(delay_s=1e-4)
    cases = corners(judged.design.uncertainty)
    sweep = judged.coarse.at((0.01, 0.2))
    found = sweep.judge(cases)
    assert found.radius == pytest.approx(sweep.worst(cases).radius, rel=1e-9)
    assert found.disk_margin == pytest.approx(sweep.disk_margin(cases)[0], rel=1e-6)
    early, late = (sweep.judge([c for c in cases if (c.delay_s > 0.0) == late]).disk_margin for late in (False, True))
    assert found.disk_margin == min(early, late) and early != late
