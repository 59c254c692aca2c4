"""Weighting functions of the local sets (Fig. 2): partition of unity, continuity, and what the law makes of them."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.kernels.laws.local import LocalGains
from servod.kernels.laws.weights import Sets, Shape, blended, weights
from tests.kernels.laws.cases import NODES

shapes = st.sampled_from(list(Shape))
speeds = st.floats(-2.0, 2.0)
node_lists = st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=6, unique_by=lambda v: round(v, 3)).map(
    lambda positive: sorted([-v for v in positive] + [0.0] + positive)
)


def shipped_set(name: str) -> LocalGains:
    """Parameters of a local law that ships."""
    return LocalGains.from_flat(load_gains(shipped(f"gains/{name}.yaml")).pack())


@given(shape=shapes, nodes=node_lists, v=speeds)
def test_weights_are_a_partition_of_unity(shape: Shape, nodes: list[float], v: float) -> None:
    mu = weights(shape, nodes, v)
    assert len(mu) == len(nodes)
    assert all(m >= 0.0 for m in mu)
    assert sum(mu) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize("index", range(len(NODES)))
def test_a_node_belongs_to_its_set_alone(shape: Shape, index: int) -> None:
    mu = weights(shape, NODES, NODES[index])
    assert mu[index] == pytest.approx(1.0)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize("index", range(len(NODES)))
def test_nothing_jumps_at_a_node(shape: Shape, index: int) -> None:
    """Weights, decay and gain on both sides of a node, 1 nrad/s away, are those of the node."""
    sets = shipped_set("demo_local").sets
    node = sets.nodes[index]
    at = blended(sets, float(shape), node)
    assert at == pytest.approx((sets.decays[index], sets.gains[index]))
    for side in (node - 1e-9, node + 1e-9):
        assert weights(shape, sets.nodes, side)[index] == pytest.approx(1.0, abs=1e-5)
        assert blended(sets, float(shape), side) == pytest.approx(at, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize("name", ["demo_local", "table1_kz_kv_kx"])
def test_the_compensated_friction_runs_between_the_values_of_the_map(name: str, shape: Shape) -> None:
    """c0*|v|/a(v) lies between the values at both neighbouring nodes, and moves from one to the other."""
    p = shipped_set(name)

    def friction(v: float) -> float:
        return p.stiffness * abs(v) / blended(p.sets, float(shape), v)[0]

    for low, high in itertools.pairwise(p.sets.nodes):
        if 0.0 in (low, high):
            continue
        steps = [friction(low + k / 50 * (high - low)) for k in range(51)]
        way = [(b - a) * (steps[-1] - steps[0]) for a, b in itertools.pairwise(steps)]
        assert min(way) >= -1e-12
        assert 0.0 < min(steps) <= max(steps) < 0.2


@pytest.mark.parametrize("shape", list(Shape))
def test_next_to_standstill_the_friction_of_the_slowest_set_holds(shape: Shape) -> None:
    """A node at rest with a decay of 0 takes nothing from the friction of its neighbour."""
    sets = Sets((-0.01, 0.0, 0.01), (8.0, 0.0, 8.0), (0.0, 0.0, 0.0))
    for v in (-0.009, -0.001, 1e-6, 0.002, 0.008):
        assert abs(v) / blended(sets, float(shape), v)[0] == pytest.approx(0.01 / 8.0)


@pytest.mark.parametrize("shape", list(Shape))
def test_weights_have_no_jump(shape: Shape) -> None:
    grid = [-0.6 + 1.2 * k / 200_000 for k in range(90_000, 110_000)]
    rows = [weights(shape, NODES, v) for v in grid[::10]]
    jumps = [max(abs(a - b) for a, b in zip(x, y, strict=True)) for x, y in itertools.pairwise(rows)]
    assert max(jumps) < 0.25  # the narrowest gap is 1 mrad/s, the grid step 0.06 mrad/s


@given(shape=shapes, v=st.floats(-0.5, 0.5))
def test_blended_is_the_weighted_sum(shape: Shape, v: float) -> None:
    """The gain in every shape; the decay in the paper's linear one."""
    decays = [float(3 + i * i) for i in range(len(NODES))]
    gains = [0.1 * i - 0.3 for i in range(len(NODES))]
    mu = weights(shape, NODES, v)
    decay, gain = blended(Sets(NODES, decays, gains), float(shape), v)
    assert gain == pytest.approx(sum(m * g for m, g in zip(mu, gains, strict=True)), rel=1e-9, abs=1e-12)
    if shape is Shape.LINEAR:
        assert decay == pytest.approx(sum(m * a for m, a in zip(mu, decays, strict=True)), rel=1e-9)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize(("v", "end"), [(-1.5, -0.5), (1.5, 0.5)])
def test_beyond_the_last_node_the_friction_keeps_its_level(v: float, end: float, shape: Shape) -> None:
    sets = Sets(NODES, [700.0 * abs(node) for node in NODES], [0.0] * len(NODES))
    at_the_end, _ = blended(sets, float(shape), end)
    beyond, _ = blended(sets, float(shape), v)
    assert abs(v) / beyond == pytest.approx(abs(end) / at_the_end)


def test_nan_velocity_gives_nan_decay() -> None:
    decay, _ = blended(Sets(NODES, [1.0] * 9, [1.0] * 9), 0.0, float("nan"))
    assert decay != decay  # noqa: PLR0124  (only NaN differs from itself)
