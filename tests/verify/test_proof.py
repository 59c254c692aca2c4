"""What a proof must not get away with: wide discs, left-out norms, NaN, and gains of a law that nobody proved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from servod.gain_design import RegionProof, Vertex
from servod.gains import load_gains
from servod.verify.checks import Subject, at_least, at_most, check_law, check_regions
from servod.verify.proof import disc_reach, proves_h2, region_margin, stored_deviation
from tests.synthesize.designs import MODEL, table1_set


def proof(index: int = 1) -> RegionProof:
    design = table1_set().design
    assert design is not None
    return design.regions[index]


def with_vertex(index: int, **changed: Any) -> RegionProof:
    """The proof of Omega_H with other values in one vertex."""
    region = proof()
    vertices = list(region.vertices)
    vertices[index] = vertices[index].model_copy(update=changed)
    return region.model_copy(update={"vertices": vertices})


def failed(region: RegionProof) -> set[str]:
    gains = table1_set()
    assert gains.design is not None
    design = gains.design.model_copy(update={"regions": [gains.design.regions[0], region]})
    return {check.name for check in check_regions(Subject(gains, design, 1, 1, 1)) if not check.passed}


def performing() -> int:
    return next(i for i, vertex in enumerate(proof().vertices) if proves_h2(vertex))


def test_a_disc_as_wide_as_one_likes_proves_nothing() -> None:
    assert disc_reach(proof()) < 1.0 and failed(proof()) == set()
    assert region_margin(with_vertex(0, disc_radius=1e6))[0] > 0.0
    assert failed(with_vertex(0, disc_radius=1e6)) == {"pole discs of region high, largest |c| + r"}


@pytest.mark.parametrize("changed", [{"lyapunov_h2": None}, {"output": None}, {"mode": "sticking"}])
def test_what_is_to_perform_needs_its_norm_and_its_own_mode(changed: dict[str, Any]) -> None:
    design = table1_set().design
    assert design is not None
    assert stored_deviation(design, with_vertex(performing(), **changed)) == math.inf


@pytest.mark.parametrize("key", ["lyapunov_disc", "lyapunov_h2", "output", "a"])
def test_nan_in_any_vertex_is_no_margin(key: str) -> None:
    vertex: Vertex = proof().vertices[performing()]
    matrix = np.array(getattr(vertex, key))
    matrix[0, 0] = math.nan
    region = with_vertex(performing(), **{key: matrix.tolist()})
    assert math.isnan(region_margin(region)[0])
    assert "LMI of region high, least relative eigenvalue" in failed(region)


def test_a_figure_that_is_no_number_fails_its_limit() -> None:
    assert not at_least("figure", math.nan, 0.0).passed
    assert not at_most("figure", math.nan, 0.0).passed


def test_the_gains_of_another_law_are_not_covered_by_pasted_proofs() -> None:
    gains = table1_set()
    assert gains.design is not None
    pasted = load_gains(MODEL.parents[1] / "demo_pd.yaml").model_copy(update={"design": gains.design})
    assert not next(check_law(Subject(pasted, gains.design, 1, 1, 1))).passed
    assert next(check_law(Subject(gains, gains.design, 1, 1, 1))).passed
