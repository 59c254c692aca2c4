"""Weighting functions of the local sets (Fig. 2): partition of unity, continuity, and what the law makes of them."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.controllers.weights import Shape, blended, weights
from tests.controllers.cases import NODES

shapes = st.sampled_from(list(Shape))
speeds = st.floats(-2.0, 2.0)
node_lists = st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=6, unique_by=lambda v: round(v, 3)).map(
    lambda positive: sorted([-v for v in positive] + [0.0] + positive)
)


@given(shape=shapes, nodes=node_lists, v=speeds)
def test_weights_are_a_partition_of_unity(shape: Shape, nodes: list[float], v: float) -> None:
    mu = weights(shape, nodes, v)
    assert len(mu) == len(nodes)
    assert all(m >= 0.0 for m in mu)
    assert sum(mu) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("shape", [Shape.LINEAR, Shape.COSINE])
@pytest.mark.parametrize("index", range(len(NODES)))
def test_a_node_belongs_to_its_set_alone(shape: Shape, index: int) -> None:
    mu = weights(shape, NODES, NODES[index])
    assert mu[index] == pytest.approx(1.0)


@pytest.mark.parametrize("index", range(len(NODES)))
def test_a_gaussian_set_is_the_strongest_at_its_node(index: int) -> None:
    mu = weights(Shape.GAUSSIAN, NODES, NODES[index])
    assert max(range(len(NODES)), key=mu.__getitem__) == index


@pytest.mark.parametrize("shape", list(Shape))
def test_weights_have_no_jump(shape: Shape) -> None:
    grid = [-0.6 + 1.2 * k / 200_000 for k in range(90_000, 110_000)]
    rows = [weights(shape, NODES, v) for v in grid[::10]]
    jumps = [max(abs(a - b) for a, b in zip(x, y, strict=True)) for x, y in itertools.pairwise(rows)]
    assert max(jumps) < 0.25  # the narrowest gap is 1 mrad/s, the grid step 0.06 mrad/s


@given(shape=shapes, v=st.floats(-0.5, 0.5))
def test_blended_is_the_weighted_sum(shape: Shape, v: float) -> None:
    decays = [float(3 + i * i) for i in range(len(NODES))]
    gains = [0.1 * i - 0.3 for i in range(len(NODES))]
    mu = weights(shape, NODES, v)
    decay, gain = blended((*NODES, *decays, *gains), 0, len(NODES), float(shape), v)
    assert decay == pytest.approx(sum(m * a for m, a in zip(mu, decays, strict=True)), rel=1e-9)
    assert gain == pytest.approx(sum(m * g for m, g in zip(mu, gains, strict=True)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize(("v", "end"), [(-1.5, -0.5), (1.5, 0.5)])
def test_beyond_the_last_node_the_friction_keeps_its_level(v: float, end: float, shape: Shape) -> None:
    p = (*NODES, *(700.0 * abs(node) for node in NODES), *([0.0] * len(NODES)))
    at_the_end, _ = blended(p, 0, len(NODES), float(shape), end)
    beyond, _ = blended(p, 0, len(NODES), float(shape), v)
    assert abs(v) / beyond == pytest.approx(abs(end) / at_the_end)


def test_nan_velocity_gives_nan_decay() -> None:
    decay, _ = blended((*NODES, *([1.0] * 18)), 0, len(NODES), 0.0, float("nan"))
    assert decay != decay  # noqa: PLR0124  (only NaN differs from itself)
