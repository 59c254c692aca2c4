"""The paper's programme in continuous time: where it has an answer, and what clashes where it has none."""

from __future__ import annotations

import numpy as np

from servod.synthesize.lmi_reference import ReferenceWishes, reference, vertices
from servod.verify.steady_friction import steady_friction
from servod.verify.vertices import Span
from tests.synthesize.designs import table1

FRICTION = steady_friction(table1())
LOW, HIGH = Span("low", 0.0, 0.02), Span("high", 0.005, 0.5)


def test_a_set_at_rest_is_infeasible_and_its_vertices_are_named() -> None:
    answer = reference(FRICTION, LOW, (0.0, 240.0), ReferenceWishes(gains_l=(0.0,)))
    assert answer.gains is None
    assert any("a=0" in line for line in answer.clashes)


def test_what_it_finds_is_stable_and_damped_at_every_vertex() -> None:
    wishes = ReferenceWishes(gains_l=(0.0,))
    answer = reference(FRICTION, HIGH, (60.0, 9000.0), wishes)
    assert answer.gains is not None and answer.clashes == ()
    for vertex in vertices(FRICTION, HIGH, (60.0, 9000.0), wishes):
        poles = np.linalg.eigvals(vertex.a - vertex.b2 @ np.array([answer.gains]))
        assert poles.real.max() < -wishes.least_decay_per_s * (1.0 - 1e-3)
        assert (-poles.real / np.abs(poles)).min() > wishes.least_damping * (1.0 - 1e-3)
