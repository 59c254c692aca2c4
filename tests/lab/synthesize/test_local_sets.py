"""Local sets hold the map within their tolerance, with the interpolation that the law itself does."""

from __future__ import annotations

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws.weights import Sets, blended
from servod.lab.synthesize.local_sets import (
    PAPER_NODES,
    adjacent_mismatch,
    compensator,
    largest_mismatch,
    local_sets,
    sets_at,
)
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1, table1_set

FRICTION = steady_friction(table1())
COMPENSATOR = compensator(FRICTION, 0.5, 0.8)


@pytest.mark.parametrize("accuracy", [0.005, 0.02, 0.1])
def test_the_force_between_nodes_is_within_the_tolerance(accuracy: float) -> None:
    sets = local_sets(FRICTION, COMPENSATOR, 0.5, accuracy, 0.0)
    at = Sets([s.velocity_rad_s for s in sets], [s.decay_per_s for s in sets], [0.0] * len(sets))
    for v in [side * v for side in (1, -1) for v in np.geomspace(0.0006, 0.5, 301)]:
        decay, _ = blended(at, 0.0, v)
        assert COMPENSATOR.torque(decay, abs(v)) == pytest.approx(abs(FRICTION.torque(v)), rel=1.02 * accuracy)


def test_a_finer_tolerance_needs_more_sets_and_they_are_dense_where_friction_bends() -> None:
    coarse, fine = (local_sets(FRICTION, COMPENSATOR, 0.5, accuracy, 0.0) for accuracy in (0.05, 0.005))
    assert len(fine) > len(coarse)
    nodes = np.array([s.velocity_rad_s for s in fine if s.velocity_rad_s > 0.0])
    assert np.diff(nodes).min() < 0.1 * np.diff(nodes).max()


def test_the_papers_nodes_give_the_map_at_the_nodes_by_equation_7() -> None:
    for s in sets_at(FRICTION, COMPENSATOR, PAPER_NODES, 0.0):
        if s.velocity_rad_s:
            torque = COMPENSATOR.torque(s.decay_per_s, abs(s.velocity_rad_s))
            assert torque == pytest.approx(abs(FRICTION.torque(s.velocity_rad_s)))
        else:
            assert s.decay_per_s == 0.0


def test_equation_8_settles_to_the_difference_of_the_map() -> None:
    sets = sets_at(FRICTION, COMPENSATOR, PAPER_NODES, 0.0)
    mismatch = adjacent_mismatch(COMPENSATOR, sets, 100.0)
    expected = FRICTION.torque(0.5) - FRICTION.torque(0.12)
    assert mismatch[-1] == pytest.approx(expected, rel=1e-6)


def test_equation_8_is_told_of_the_neighbours_that_are_furthest_apart() -> None:
    law = table1_set().parameters
    assert isinstance(law, LocalParameters)
    found = largest_mismatch(law.friction, 100.0)
    assert found is not None and found.from_rad_s * found.to_rad_s > 0.0
    forces = [FRICTION.torque(s.velocity_rad_s) for s in law.friction.sets if s.velocity_rad_s > 0.0]
    steps = np.abs(np.diff(forces))
    assert abs(found.difference_nm) <= steps.max() * 1.001
    assert 0.0 < found.share < 0.5


def test_more_sets_than_the_law_holds_are_refused() -> None:
    with pytest.raises(BadInput, match="local sets"):
        local_sets(FRICTION, COMPENSATOR, 0.5, 1e-4, 0.0)
