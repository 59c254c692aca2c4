"""The second solver: it agrees on a design, and a disagreement or one-sided answer is told as such."""

from __future__ import annotations

import pytest

from servod.formats.gains.gain_set import GainSet
from servod.lab.synthesize.crosscheck import TOLERANCE, Norms, deployed_norm, reference_norm
from servod.lab.synthesize.reference import reference_set
from tests.lab.synthesize.designs import table1, table1_set


def test_scs_finds_clarabels_bound_for_some_vertices() -> None:
    design = table1_set().design
    assert design is not None
    region = design.regions[1]
    some = region.model_copy(update={"vertices": [v for v in region.vertices if v.lyapunov_h2 is not None][:2]})
    norms = [deployed_norm(some, solver) for solver in ("CLARABEL", "SCS")]
    assert norms[0] is not None and norms[1] == pytest.approx(norms[0], rel=TOLERANCE)
    assert Norms(*norms).check("high").agrees


def test_scs_finds_clarabels_bound_for_the_papers_programme() -> None:
    found = reference_set(table1())
    assert isinstance(found, GainSet) and found.design is not None
    norms = [reference_norm(found.design, found.design.reference[1], solver) for solver in ("CLARABEL", "SCS")]
    assert norms[0] is not None and norms[1] == pytest.approx(norms[0], rel=TOLERANCE)


@pytest.mark.parametrize(
    ("first", "other", "agrees"),
    [(1.0, 1.01, True), (1.0, 1.1, False), (1.0, None, False), (None, 1.0, False), (None, None, True)],
)
def test_agreement_is_in_feasibility_and_in_the_bound(first: float | None, other: float | None, agrees: bool) -> None:
    told = Norms(first, other).check("low")
    assert told.agrees is agrees
    assert (told.difference is None) == (first is None or other is None)
