"""The inequalities (14) of a set of the reference mode, evaluated by eigenvalues from the stored P, Y and Q.

Stands on the vertices that are made anew from the model and from the law's own sets; no solver. It proves what the
paper proves: the continuous loop without delay or filter. Whether the sampled loop stands is checked apart.
"""

from __future__ import annotations

import math

import numpy as np

from servod.formats.gains.design import Design, ReferenceOutput, ReferenceProof
from servod.formats.gains.parameters import LocalFriction, RegionGains
from servod.lab.verify.proof import relative_margin
from servod.lab.verify.reference_vertices import ContinuousVertex, Polytope, polytope, vertices
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import Span


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


def stored_polytope_deviation(design: Design, law: LocalFriction, proof: ReferenceProof) -> float:
    """Largest relative difference between the stored intervals and those made anew from model and law."""
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
