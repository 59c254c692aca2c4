"""The inequalities (14) of a set of the reference mode, evaluated by eigenvalues from the stored P, Y and Q.

Stands on the vertices that are made again from the model and from the law's own sets; no solver. It proves what the
paper proves: the continuous loop without delay or filter. Whether the sampled loop stands is checked apart.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from servod.formats.gains.design import Design, ReferenceForm, ReferenceOutput, ReferenceProof, Uncertainty
from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.gains.parameters import LocalFrictionSets, LocalParameters, RegionGains
from servod.kernels.laws.weights import Shape, blended
from servod.lab.verify.checks import SAME, Subject, at_least, at_most
from servod.lab.verify.proof import relative_margin
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction
from servod.lab.verify.vertices import Span, ends

# --- Vertices of (15) ------------------------------------------------------------------------------------------------
# Vertices of the paper's polytope (15): what the reference mode solves over and its proof is evaluated on. Physically
# consistent with (12), states (z_hat, x, v):
#
#     A_i = [-a, 0, 1; 0, 0, 1; -dc/m, -kappa/m, -dd/m],  B_2i = [l, 0, K/m],  B_1 = [1, 0; 0, 0; 0, 1/m].
#
# Printed, row 3 is (dc, kappa, dd) with B_2 = [l, 0, K] and B_1 = [1, 0, 1]: wrong in sign, without the inertia, and
# with one disturbance that enters in two places.


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


def polytope(friction: SteadyFriction, law: LocalFrictionSets, span: Span, u: Uncertainty) -> Polytope:
    """The polytope of a region: what the law's local sets do there, against the model within its intervals."""
    nodes = [s.velocity_rad_s for s in law.sets]
    sets = law.named()
    edges = [side * speed for side in (1.0, -1.0) for speed in (span.from_rad_s, span.to_rad_s)]
    inside = [v for v in nodes if span.from_rad_s <= abs(v) <= span.to_rad_s]
    shape = float(Shape[law.weights.name])
    at = [blended(sets, shape, v) for v in (*edges, *inside)]
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


def output_rows(proof: ReferenceProof, lyapunov: Array, y: Array) -> Array:
    """(C' + D' K_u*) P in scaled states: alpha x and beta u*, as two outputs or as their sum."""
    position = proof.position_weight * proof.scale[1] * lyapunov[1]
    torque = proof.torque_weight * y
    return (position + torque)[None] if proof.output is ReferenceOutput.SCALAR else np.stack([position, torque])


def vertex_blocks(proof: ReferenceProof, vertex: ContinuousVertex) -> dict[str, Array]:
    """The matrices of one vertex that must be positive: the first of (14), least decay, cone of the damping ratio."""
    scale, p, y = np.array(proof.scale), np.array(proof.lyapunov), np.array(proof.feedback_lyapunov)[None]
    flow = vertex.a * (scale / scale[:, None]) @ p + vertex.b2 / scale[:, None] @ y
    b1, both, turn = vertex.b1 / scale[:, None], flow + flow.T, math.acos(proof.least_damping)
    wide, skew = math.sin(turn) * both, math.cos(turn) * (flow - flow.T)
    return {
        "norm": -np.block([[both, b1], [b1.T, -np.eye(b1.shape[1])]]),
        "decay": -both - 2.0 * proof.least_decay_per_s * p,
        "damping": -np.block([[wide, skew], [-skew, wide]]),
    }


def reference_margin(design: Design, proof: ReferenceProof) -> float:
    """Least relative eigenvalue of all inequalities at all vertices of the stored polytope; positive when they hold."""
    friction = steady_friction(design.model)
    p, y = np.array(proof.lyapunov), np.array(proof.feedback_lyapunov)
    found = vertices(
        proof.name, Polytope.stored(proof), friction.inertia, friction.stiffness, proof.input_scale_nm, proof.form
    )
    rows = output_rows(proof, p, y)
    blocks = [p, np.block([[np.array(proof.bound), rows], [rows.T, p]])]
    blocks += [block for vertex in found for block in vertex_blocks(proof, vertex).values()]
    return float(np.min([_balanced_margin(block) for block in blocks]))


def _balanced_margin(matrix: Array) -> float:
    """Relative margin after each state was scaled by its own diagonal, which no sign depends on."""
    size = np.sqrt(np.maximum(np.abs(np.diag(matrix)), 1e-300))
    return relative_margin(matrix / np.outer(size, size))


def stored_polytope_deviation(design: Design, law: LocalFrictionSets, proof: ReferenceProof) -> float:
    """Largest relative difference between the stored intervals and those made again from model and law."""
    span = Span(proof.name, proof.speed_from_rad_s, proof.speed_to_rad_s)
    made = polytope(steady_friction(design.model), law, span, design.uncertainty)
    kept = Polytope.stored(proof)
    pairs = [(getattr(made, name)[i], getattr(kept, name)[i]) for name in Polytope.__dataclass_fields__ for i in (0, 1)]
    return float(np.max([abs(x - y) / max(abs(x), abs(y), 1e-12) for x, y in pairs]))


def gain_numbers(proof: ReferenceProof) -> tuple[float, float, float]:
    """(k_z, k_x, k_v) of (13) as negative feedback, -Y inv(P) in SI units per unit of u*; of any sign."""
    y, p = np.array(proof.feedback_lyapunov), np.array(proof.lyapunov)
    k_z, k_x, k_v = (-np.linalg.solve(p.T, y) / np.array(proof.scale)).tolist()
    return k_z, k_x, k_v


def reference_gains(proof: ReferenceProof) -> RegionGains:
    """The law's gains of the region; position and velocity feedback must not be negative."""
    k_z, k_x, k_v = gain_numbers(proof)
    return RegionGains(k_z_per_rad=k_z, k_x_per_rad=k_x, k_v_s_per_rad=k_v)


# --- Checks of both modes --------------------------------------------------------------------------------------------
# Checks of a set's proofs that hold for both modes: that every region has one, and the paper's own inequalities. What
# the reference mode proves says nothing of the sampled loop; the other checks judge that.


REGIONS = 2


def check_reference(s: Subject) -> Iterator[CertificateCheck]:
    """A proof for each region; (14) by eigenvalues; its polytope as model and law say; the law's gains as proven."""
    proofs = s.design.reference
    proven = {proof.name for proof in s.design.regions} | {proof.name for proof in proofs}
    yield at_least("regions with a proof", float(len(proven & {"low", "high"})), REGIONS)
    local = s.gains.parameters
    for proof in proofs:
        yield at_least(
            f"(14) of region {proof.name}, least relative eigenvalue", reference_margin(s.design, proof), 0.0
        )
        if isinstance(local, LocalParameters):
            away = stored_polytope_deviation(s.design, local.friction, proof)
            yield at_most(f"polytope of region {proof.name} against model and law", away, SAME)
            own = getattr(local.regions, proof.name)
            used = (own.k_z_per_rad, own.k_x_per_rad, own.k_v_s_per_rad)
            pairs = list(zip(used, gain_numbers(proof), strict=True))
            worst = float(np.max([abs(x - y) / max(abs(x), abs(y), 1e-12) for x, y in pairs]))
            away = worst + sum(map(abs, own.memory))
            yield at_most(f"gains of region {proof.name} against the proven ones", away, SAME)
