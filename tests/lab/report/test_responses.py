"""Responses of sampled systems against closed forms, and the figures of a whole design."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from servod.lab.report.figures.loop import bode, impulse_responses
from servod.lab.report.responses import (
    before,
    closed_loop_response,
    frequency_response,
    impulse_response,
    rigid,
    vertex_impulse,
)
from servod.lab.verify.closed_loop import spectral_radius
from servod.lab.verify.proof import closed
from tests.lab.synthesize.designs import table1_set

PERIOD_S = 1e-3


def test_frequency_response_of_a_first_order_low_pass() -> None:
    """y(k+1) = p y(k) + (1 - p) u(k): the magnitude is known at every frequency."""
    pole, f = 0.9, np.array([0.0, 5.0, 50.0, 400.0])
    found = frequency_response(np.array([[pole]]), np.array([1.0 - pole]), np.array([1.0]), PERIOD_S, f)
    z = np.exp(2j * np.pi * f * PERIOD_S)
    assert found == pytest.approx((1.0 - pole) / (z - pole))
    assert abs(found[0]) == pytest.approx(1.0)


def test_energy_of_the_impulse_response_is_the_gramians() -> None:
    """The sum of squares is trace(C P C'), P = A P A' + b b': the squared H2 norm, at every vertex of both regions."""
    design = table1_set().design
    assert design is not None
    for region in design.regions:
        for vertex in region.vertices:
            a, c = closed(region, vertex)
            gramian = solve_discrete_lyapunov(a, np.outer(vertex.e, vertex.e))
            energy = float(np.sum(vertex_impulse(region, vertex, 6000) ** 2))
            assert energy == pytest.approx(float(np.trace(c @ gramian @ c.T)), rel=1e-4)
            if vertex.output is not None:
                assert energy <= np.trace(np.array(vertex.output)) * (1.0 + 1e-9)


def test_impulse_response_begins_with_the_input_itself() -> None:
    a, b, c = np.array([[0.5, 0.1], [0.0, 0.2]]), np.array([1.0, 2.0]), np.eye(2)
    found = impulse_response(a, b, c, 3)
    assert found == pytest.approx(np.array([b, a @ b, a @ a @ b]))


def test_without_friction_counting_every_loop_is_the_rigid_joint() -> None:
    """At high frequency the inertia alone answers, before and after compensation."""
    gains = table1_set()
    assert gains.design is not None
    f = np.array([60.0, 100.0])
    ideal = np.abs(rigid(gains.design, f))
    law = gains.parameters
    for velocity in (0.001, 0.2):
        for loop in (before(gains.design, velocity), closed_loop_response(gains.design, law, velocity, False)):  # type: ignore[arg-type]
            seen = np.abs(frequency_response(*loop, PERIOD_S, f))
            assert seen == pytest.approx(ideal, rel=0.3)


def test_before_at_rest_is_the_bristle_s_spring() -> None:
    gains = table1_set()
    assert gains.design is not None
    static = np.abs(frequency_response(*before(gains.design, 0.0), PERIOD_S, np.array([0.05])))
    assert static[0] == pytest.approx(1.0 / 950.0, rel=0.02)
    assert spectral_radius(before(gains.design, 0.0)[0][None])[0] < 1.0


def test_fig_4_and_fig_6_have_a_column_for_each_half() -> None:
    gains = table1_set()
    drawn = bode(gains)
    assert len(drawn.panels) == 4 and drawn.columns == 2
    labels = {c.label for p in drawn.panels for c in p.curves}
    assert {"before", "after (9)", "rigid joint without friction"} <= labels
    impulses = impulse_responses(gains)
    assert gains.design is not None
    for panel, region in zip(impulses.panels, [*gains.design.regions] * 2, strict=True):
        assert [c.detail for c in panel.curves] == [v.name for v in region.vertices]
