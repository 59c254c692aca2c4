"""Vertices of the paper's polytope (15): what the reference mode solves over and its proof is evaluated on.

Stands on the steady friction and the law's own local sets. Physically consistent with (12), states (z_hat, x, v):

    A_i = [-a, 0, 1; 0, 0, 1; -dc/m, -kappa/m, -dd/m],  B_2i = [l, 0, K/m],  B_1 = [1, 0; 0, 0; 0, 1/m].

Printed, row 3 is (dc, kappa, dd) with B_2 = [l, 0, K] and B_1 = [1, 0, 1]: wrong in sign, without the inertia, and with
one disturbance that enters in two places.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from servod.formats.gains.design import ReferenceForm, ReferenceProof, Uncertainty
from servod.formats.gains.parameters import LocalFriction
from servod.kernels.laws.weights import Shape, blended
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import SteadyFriction
from servod.lab.verify.vertices import Span, ends

KAPPA_SHARE = 0.01  # kappa of (15), the small gain that provides a solution, as a share of c0
Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Polytope:
    """Intervals of a_i [1/s], dc_i [N*m/rad], dd_i [N*m*s/rad] and l_i over one region."""

    decays: Interval
    stiffness: Interval
    viscous: Interval
    gains_l: Interval

    @staticmethod
    def stored(proof: ReferenceProof) -> Polytope:
        """The polytope that a proof says it is about."""
        rows = (
            proof.decays_per_s,
            proof.stiffness_mismatch_nm_per_rad,
            proof.viscous_mismatch_nms_per_rad,
            proof.gains_l,
        )
        return Polytope(*((row[0], row[1]) for row in rows))


@dataclass(frozen=True, slots=True)
class ContinuousVertex:
    """One vertex of (15), in SI units."""

    name: str
    a: Array
    b1: Array
    b2: Array


def polytope(friction: SteadyFriction, law: LocalFriction, span: Span, u: Uncertainty) -> Polytope:
    """The polytope of a region: what the law's local sets do there, against the model within its intervals."""
    nodes = [s.velocity_rad_s for s in law.sets]
    packed = [*nodes, *(s.decay_per_s for s in law.sets), *(s.gain for s in law.sets)]
    edges = [side * speed for side in (1.0, -1.0) for speed in (span.from_rad_s, span.to_rad_s)]
    inside = [v for v in nodes if span.from_rad_s <= abs(v) <= span.to_rad_s]
    shape = float(Shape[law.weights.name])
    at = [blended(packed, 0, len(nodes), shape, v) for v in (*edges, *inside)]
    decays = [max(decay, law.leak_per_s) for decay, _ in at]
    stiff = [friction.stiffness * end - law.stiffness_nm_per_rad for end in ends(u.stiffness)]
    viscous = [friction.viscous(v) * end - law.viscous_nms_per_rad for v in edges for end in ends(u.viscous)]
    gains = [gain for _, gain in at]
    return Polytope(*((min(values), max(values)) for values in (decays, stiff, viscous, gains)))


def vertices(
    name: str, p: Polytope, inertia: float, stiffness: float, input_scale_nm: float, form: ReferenceForm
) -> list[ContinuousVertex]:
    """All corners of the polytope as the matrices of (15); an interval without width has one end."""
    found = []
    for a, dc, dd, gain in itertools.product(*(sorted(set(i)) for i in (p.decays, p.stiffness, p.viscous, p.gains_l))):
        last, kappa = np.array([-dc, -KAPPA_SHARE * stiffness, -dd]), KAPPA_SHARE * stiffness
        if form is ReferenceForm.PRINTED:
            matrix = np.array([[-a, 0.0, 1.0], [0.0, 0.0, 1.0], [dc, kappa, dd]])
            b1, b2 = np.array([[1.0], [0.0], [1.0]]), np.array([[gain], [0.0], [input_scale_nm]])
        else:
            matrix = np.array([[-a, 0.0, 1.0], [0.0, 0.0, 1.0], last / inertia])
            b1 = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0 / inertia]])
            b2 = np.array([[gain], [0.0], [input_scale_nm / inertia]])
        found.append(ContinuousVertex(f"{name}: a={a:.3g} dc={dc:.3g} dd={dd:.3g} l={gain:g}", matrix, b1, b2))
    return found
