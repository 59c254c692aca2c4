"""What a proof must not get away with: wide discs, left-out norms, NaN, and gains of a law that nobody proved."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.yaml import validate
from servod.formats.gains.design import RegionProof, Vertex
from servod.formats.gains.gain_set import load_gains
from servod.formats.gains.parameters import LocalParameters
from servod.lab.verify.checks import Subject, at_least, at_most, check_law, check_regions
from servod.lab.verify.proof import disc_reach, proves_h2, region_margin, stored_deviation
from tests.lab.synthesize.designs import MODEL, table1_set


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


def overlapping(from_rad_s: float, to_rad_s: float) -> set[str]:
    """Checks of the regions that fail when the law goes over from one to the other at other speeds."""
    gains = table1_set()
    assert gains.design is not None and isinstance(gains.parameters, LocalParameters)
    speeds = {"overlap_from_rad_s": from_rad_s, "overlap_to_rad_s": to_rad_s}
    regions = gains.parameters.regions.model_copy(update=speeds)
    other = gains.model_copy(update={"parameters": gains.parameters.model_copy(update={"regions": regions})})
    return {check.name for check in check_regions(Subject(other, gains.design, 1, 1, 1)) if not check.passed}


def test_a_law_uses_gains_only_at_the_speeds_of_their_proof() -> None:
    assert overlapping(0.2, 0.4) == {"speeds of region low that no proof covers [rad/s]"}
    assert overlapping(0.001, 0.02) == {"speeds of region high that no proof covers [rad/s]"}


def short(matrix: list[list[float]]) -> list[list[float]]:
    return matrix[:-1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda region: region["vertices"][0].update(a=short(region["vertices"][0]["a"])), "a is not 6 by 6"),
        (lambda region: region["vertices"][0].update(b=[1.0]), "b and e have 6 entries"),
        (lambda region: region["vertices"][0].update(mode="flying"), "no matrix for its mode flying"),
        (lambda region: region.update(slack={}), "no matrix for its mode"),
        (lambda region: region.update(feedback=[]), "feedback has 0 entries"),
        (lambda region: region.update(name="middle"), "name"),
    ],
)
def test_matrices_that_do_not_fit_each_other_are_bad_input(change: Callable[[dict[str, Any]], None], said: str) -> None:
    region = proof().model_dump()
    change(region)
    with pytest.raises(BadInput, match=said):
        validate(region, RegionProof, "set.yaml")
