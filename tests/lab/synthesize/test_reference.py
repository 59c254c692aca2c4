"""The paper's programme in continuous time: where it has an answer, what clashes where it has none, what it proves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.formats.gains.design import DesignMode, ReferenceForm, ReferenceOutput
from servod.formats.gains.gain_set import GainSet, parse_gains
from servod.formats.gains.parameters import LocalParameters
from servod.lab.synthesize import infeasible
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import DesignOptions
from servod.lab.synthesize.infeasible import Infeasible
from servod.lab.synthesize.lmi_reference import ReferenceWishes, programme, reference, solve
from servod.lab.synthesize.reference import frame, reference_set
from servod.lab.verify.certify import verify
from servod.lab.verify.checks import Subject
from servod.lab.verify.reference_proof import (
    Polytope,
    check_reference,
    gain_numbers,
    polytope,
    reference_margin,
    vertices,
)
from tests.lab.synthesize.designs import table1


@pytest.fixture(scope="module")
def papers() -> GainSet:
    found = reference_set(table1())
    assert isinstance(found, GainSet)
    return found


def test_the_set_says_its_mode_and_reads_back_equal(papers: GainSet) -> None:
    assert papers.design is not None and papers.design.mode is DesignMode.REFERENCE
    assert parse_gains(papers.to_yaml(), "set") == papers and not papers.seal_broken


@pytest.mark.parametrize("index", [0, 1])
def test_every_vertex_is_stable_and_damped_as_asked(papers: GainSet, index: int) -> None:
    assert papers.design is not None
    proof = papers.design.reference[index]
    made = frame(table1(), Wishes(), DesignOptions(), ReferenceWishes())
    for vertex in vertices(
        proof.name,
        Polytope.stored(proof),
        made.friction.inertia,
        made.friction.stiffness,
        proof.input_scale_nm,
        proof.form,
    ):
        poles = np.linalg.eigvals(vertex.a - vertex.b2 @ np.array([gain_numbers(proof)]))
        assert poles.real.max() < -proof.least_decay_per_s * (1.0 - 1e-6)
        assert (-poles.real / np.abs(poles)).min() > proof.least_damping * (1.0 - 1e-6)


def test_the_h2_norm_by_integration_is_within_the_bound(papers: GainSet) -> None:
    """The impulse responses from w to (alpha x, beta u*) at every vertex hold no more than the bound's energy."""
    made = frame(table1(), Wishes(), DesignOptions(), ReferenceWishes())
    span = made.spans[1]
    answer = made.answer(span)
    assert answer.proof is not None and answer.norm is not None
    k = np.array([gain_numbers(answer.proof)])
    region = programme(
        made.friction, span, polytope(made.friction, made.law.friction, span, made.design.uncertainty), made.asked
    )
    outputs = np.vstack([[0.0, made.asked.position_weight, 0.0], -made.asked.torque_weight * k])
    for vertex in region.found:
        closed = vertex.a - vertex.b2 @ k
        step = np.eye(3) + 2e-5 * closed @ (np.eye(3) + 1e-5 * closed)
        state, energy = vertex.b1.copy(), 0.0
        for _ in range(40_000):
            energy += 2e-5 * float(np.sum((outputs @ state) ** 2))
            state = step @ state
        assert math.sqrt(energy) < answer.norm * 1.02


def test_a_set_at_rest_is_infeasible_and_its_vertices_and_constraints_are_named() -> None:
    found = reference_set(table1(), options=DesignOptions(leak_per_s=0.0))
    assert isinstance(found, Infeasible) and found.regions == ("low",)
    assert any(line.startswith("norm: low: a=0") for line in found.clashes)
    offered = {r.wish: r.enough for r in found.relaxations}
    leak = offered["leak of the friction state [1/s]"]
    assert isinstance(reference_set(table1(), options=DesignOptions(leak_per_s=leak)), GainSet)


def test_an_offered_decay_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(infeasible, "RELAX_STEPS", 2)
    asked = ReferenceWishes(least_decay_per_s=50.0)
    found = reference_set(table1(), asked=asked)
    assert isinstance(found, Infeasible)
    enough = {r.wish: r.enough for r in found.relaxations}["least decay [1/s]"]
    assert 0.0 < enough < 50.0
    assert isinstance(reference_set(table1(), asked=replace(asked, least_decay_per_s=enough)), GainSet)


def test_l_that_helps_the_axis_is_refused_by_15_whose_integrator_lost_its_path() -> None:
    found = reference_set(table1(), options=DesignOptions(gain=0.04))
    assert isinstance(found, Infeasible)
    assert all("positive feedback" in line for line in found.clashes)
    assert any(r.wish == "l" and r.enough == 0.0 for r in found.relaxations)


@pytest.mark.parametrize("output", list(ReferenceOutput))
def test_both_forms_and_outputs_are_programmes_with_an_answer(output: ReferenceOutput) -> None:
    norms = {}
    for form in ReferenceForm:
        made = frame(table1(), Wishes(), DesignOptions(), ReferenceWishes(form=form, output=output))
        answer = made.answer(made.spans[1])
        assert answer.proof is not None and reference_margin(made.design, answer.proof) > 0.0
        norms[form] = answer.norm
    assert norms[ReferenceForm.PRINTED] != pytest.approx(norms[ReferenceForm.CONSISTENT], rel=0.1)


def test_the_literal_sum_never_costs_more_than_both_outputs() -> None:
    """|alpha x + beta u*| at their best phase is at most sqrt 2 of the pair."""
    made = frame(table1(), Wishes(), DesignOptions(), ReferenceWishes())
    span = made.spans[1]
    intervals = polytope(made.friction, made.law.friction, span, made.design.uncertainty)
    norms = [
        reference(made.friction, span, intervals, replace(made.asked, output=output)).norm for output in ReferenceOutput
    ]
    assert norms[0] is not None and norms[1] is not None
    assert norms[1] <= math.sqrt(2.0) * norms[0] * 1.001


def test_a_region_without_constraints_is_feasible() -> None:
    made = frame(table1(), Wishes(), DesignOptions(), ReferenceWishes())
    intervals = polytope(made.friction, made.law.friction, made.spans[1], made.design.uncertainty)
    assert solve(programme(made.friction, made.spans[1], intervals, made.asked), frozenset()) is not None


def test_verification_confirms_what_the_paper_proves_and_refuses_the_sampled_loop(papers: GainSet) -> None:
    assert papers.design is not None
    assert all(check.passed for check in check_reference(Subject(papers, papers.design, 1, 1, 1)))
    judged = verify(papers, plants=1, processes=1)
    assert not judged.valid
    assert any(check.name.startswith("largest pole") and not check.passed for check in judged.checks)


def test_changed_gains_or_sets_do_not_fit_the_proof(papers: GainSet) -> None:
    law = papers.parameters
    assert isinstance(law, LocalParameters) and papers.design is not None
    low = law.regions.low.model_copy(update={"k_x_per_rad": 1.01 * law.regions.low.k_x_per_rad})
    regions = law.regions.model_copy(update={"low": low})
    leak = law.friction.model_copy(update={"leak_per_s": 3.0})
    for changed, named in (
        ({"regions": regions}, "gains of region low"),
        ({"friction": leak}, "polytope of region low"),
    ):
        other = papers.model_copy(update={"parameters": law.model_copy(update=changed)})
        failed = [c.name for c in check_reference(Subject(other, papers.design, 1, 1, 1)) if not c.passed]
        assert any(name.startswith(named) for name in failed)


def test_a_design_without_proofs_is_no_design(papers: GainSet) -> None:
    assert papers.design is not None
    bare = papers.design.model_copy(update={"reference": []})
    assert not next(check_reference(Subject(papers, bare, 1, 1, 1))).passed
