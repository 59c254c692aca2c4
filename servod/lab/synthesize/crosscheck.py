"""Cross-check of a design: the same programme, solved once more by Clarabel and by SCS, must come to the same answer.

Beside the synthesis, which takes Clarabel's answer. The two share no code and no method (interior point against
operator splitting), so that a programme on which they agree was not decided by one solver's quirks. The programme is
the stored one: vertices, pole discs and the slack's structure of the deployed mode, or the polytope of the reference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servod.formats.gains.design import Design, ReferenceProof, RegionProof
from servod.formats.gains.gain_set import CrossCheck, GainSet
from servod.lab.synthesize import lmi_deployed, lmi_reference
from servod.lab.synthesize.lmi_deployed import Programme, Solution
from servod.lab.synthesize.lmi_reference import PARTS, ReferenceWishes
from servod.lab.verify.reference_proof import Polytope
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import Span

SOLVER, OTHER = "CLARABEL", "SCS"
TOLERANCE = 0.02  # of the H2 bound, relative


@dataclass(frozen=True, slots=True)
class Norms:
    """H2 bounds of one region's programme by both solvers; None where one found no solution."""

    first: float | None
    other: float | None

    def check(self, region: str) -> CrossCheck:
        """The outcome as it is stored."""
        both = self.first is not None and self.other is not None
        difference = abs(self.other - self.first) / self.first if both and self.first and self.other else None
        agrees = difference <= TOLERANCE if difference is not None else self.first is self.other is None
        return CrossCheck(
            region=region,
            solver=OTHER,
            h2_bound=self.first,
            other_h2_bound=self.other,
            difference=difference,
            tolerance=TOLERANCE,
            agrees=agrees,
        )


def stored_programme(proof: RegionProof, solver: str) -> tuple[Programme, Solution]:
    """The LMI programme of a stored region of the deployed mode, and the solution that gives its slack's structure."""
    vertices = proof.vertices
    programme = Programme(
        [v.mode for v in vertices],
        [v.lyapunov_h2 is not None for v in vertices],
        np.array([v.a for v in vertices]),
        np.array([v.b for v in vertices]),
        np.array([v.e for v in vertices]),
        proof.position_weight,
        proof.torque_weight,
        [(v.disc_centre, v.disc_radius) for v in vertices],
        solver,
        len(proof.feedback),
    )
    slack = {mode: np.array(matrix) for mode, matrix in proof.slack.items()}
    return programme, Solution(np.array(proof.feedback), slack, [], [], [])


def deployed_norm(proof: RegionProof, solver: str) -> float | None:
    """Root of the summed squared H2 bounds that `solver` finds for a region, over the vertices that shape feedback."""
    programme, found = stored_programme(proof, solver)
    shaping = programme.only("sliding")
    solution = lmi_deployed.solve(shaping, None, found.upper_slack())
    if solution is None:
        return None
    return math.sqrt(max(sum(float(np.trace(w)) for w in solution.outputs if w is not None), 0.0))


def reference_norm(design: Design, proof: ReferenceProof, solver: str) -> float | None:
    """H2 bound that `solver` finds for a region of the reference mode."""
    asked = ReferenceWishes(
        proof.input_scale_nm,
        proof.position_weight,
        proof.torque_weight,
        proof.least_decay_per_s,
        proof.least_damping,
        proof.form,
        proof.output,
        solver,
    )
    span = Span(proof.name, proof.speed_from_rad_s, proof.speed_to_rad_s)
    friction = steady_friction(design.model)
    programme = lmi_reference.programme(friction, span, Polytope.stored(proof), asked)
    found = lmi_reference.solve(programme, frozenset(PARTS))
    return found.norm if found is not None else None


def cross_check(gains: GainSet) -> list[CrossCheck]:
    """Both solvers' answers for every region of a set."""
    assert gains.design is not None
    checks = []
    for proof in gains.design.regions:
        checks.append(Norms(deployed_norm(proof, SOLVER), deployed_norm(proof, OTHER)).check(proof.name))
    for stored in gains.design.reference:
        norms = (reference_norm(gains.design, stored, solver) for solver in (SOLVER, OTHER))
        checks.append(Norms(*norms).check(stored.name))
    return checks


def cross_checked(gains: GainSet) -> GainSet:
    """The set with the outcome in its provenance, sealed again."""
    provenance = gains.provenance.model_copy(update={"cross_checks": cross_check(gains)})
    return gains.model_copy(update={"provenance": provenance}).sealed()
