"""The LMIs of a gain set, evaluated by eigenvalues from the stored matrices: no solver, no trust in who made them.

Stands on numpy and the stored design. A margin is the least eigenvalue of a block matrix divided by its largest; the
inequality holds when it is positive.
"""

from __future__ import annotations

import math

import numpy as np

from servod.formats.gains.design import Design, RegionProof, Vertex
from servod.formats.gains.parameters import LocalParameters, RegionGains
from servod.lab.verify.sampled import Array, timing_of
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import Span, VertexJoint, joints, sampled_vertices


def relative_margin(matrix: Array) -> float:
    """Least eigenvalue of the symmetric part, as a share of the largest magnitude of its eigenvalues; NaN stays NaN."""
    if not np.isfinite(matrix).all():
        return math.nan
    values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T))
    return float(values[0] / np.abs(values).max())


def h2_state_block(a: Array, e: Array, slack: Array, lyapunov: Array) -> Array:
    """[P - E E', A G; *, G + G' - P] of the closed loop, de Oliveira's H2 condition."""
    moved = a @ slack
    return np.block([[lyapunov - np.outer(e, e), moved], [moved.T, slack + slack.T - lyapunov]])


def h2_output_block(c: Array, slack: Array, lyapunov: Array, output: Array) -> Array:
    """[W, C G; *, G + G' - P]; trace W bounds the squared H2 norm."""
    moved = c @ slack
    return np.block([[output, moved], [moved.T, slack + slack.T - lyapunov]])


def disc_block(a: Array, slack: Array, lyapunov: Array, centre: float, radius: float) -> Array:
    """[r Q, (A - c) G; *, r (G + G' - Q)]: all poles in the disc of centre c and radius r (decay and damping)."""
    moved = a @ slack - centre * slack
    return np.block([[radius * lyapunov, moved], [moved.T, radius * (slack + slack.T - lyapunov)]])


def closed(region: RegionProof, vertex: Vertex) -> tuple[Array, Array]:
    """(A closed by the feedback, output matrix of [alpha*x; beta*u]) of one vertex, in scaled states."""
    a, b = np.array(vertex.a), np.array(vertex.b)
    feedback = np.zeros(len(a))
    feedback[: len(region.feedback)] = region.feedback
    outputs = np.zeros((2, len(a)))
    outputs[0, 0] = region.position_weight
    outputs[1] = region.torque_weight * feedback
    return a + np.outer(b, feedback), outputs


def vertex_margin(region: RegionProof, vertex: Vertex) -> float:
    """Least relative margin of the inequalities at one vertex: the pole disc, and H2 where it counts."""
    a, c = closed(region, vertex)
    slack = np.array(region.slack[vertex.mode])
    margin = relative_margin(
        disc_block(a, slack, np.array(vertex.lyapunov_disc), vertex.disc_centre, vertex.disc_radius)
    )
    if vertex.lyapunov_h2 is None or vertex.output is None:
        return margin
    p = np.array(vertex.lyapunov_h2)
    state = relative_margin(h2_state_block(a, np.array(vertex.e), slack, p))
    output = relative_margin(h2_output_block(c, slack, p, np.array(vertex.output)))
    return float(np.min([margin, state, output]))


def region_margin(region: RegionProof) -> tuple[float, str]:
    """(least relative margin over all vertices, the vertex that has it); NaN counts as the least."""
    margins = [vertex_margin(region, vertex) for vertex in region.vertices]
    least = int(np.argmin(margins))
    return margins[least], region.vertices[least].name


def disc_reach(region: RegionProof) -> float:
    """Largest |c| + r of the stored pole discs: up to 1 a disc lies in the unit circle, and to be in it is to decay."""
    return float(np.max([abs(vertex.disc_centre) + vertex.disc_radius for vertex in region.vertices]))


def scaled_vertices(design: Design, region: RegionProof) -> tuple[list[VertexJoint], Array, Array, Array]:
    """Joints and scaled (A, B, E) of the region's vertices, made again from the design's model and intervals."""
    span = Span(region.name, region.speed_from_rad_s, region.speed_to_rad_s)
    found = joints(steady_friction(design.model), span, design.uncertainty)
    return found, *scaled(found, design, region)


def scaled(found: list[VertexJoint], design: Design, region: RegionProof) -> tuple[Array, Array, Array]:
    """(A, B, E) of joints in the region's scaled states."""
    a, b, e = sampled_vertices(found, timing_of(design).as_delay)
    scale = np.array(region.scale)
    torque = region.torque_scale_nm
    return a * (scale / scale[:, None]), b * torque / scale, e * torque / scale


def stored_deviation(design: Design, region: RegionProof) -> float:
    """Largest difference between the stored vertices and those made again.

    Infinite when they are not the same ones of the same mode, and where one that is to perform has no H2 proof.
    """
    found, a, b, e = scaled_vertices(design, region)
    if [(joint.name, joint.mode) for joint in found] != [(vertex.name, vertex.mode) for vertex in region.vertices]:
        return math.inf
    if any(joint.performs and not proves_h2(vertex) for joint, vertex in zip(found, region.vertices, strict=True)):
        return math.inf
    pairs = [pair for i, v in enumerate(region.vertices) for pair in ((a[i], v.a), (b[i], v.b), (e[i], v.e))]
    return float(np.max([np.abs(made - np.array(stored)).max() for made, stored in pairs]))


def proves_h2(vertex: Vertex) -> bool:
    """Whether the vertex has both matrices of its H2 proof."""
    return vertex.lyapunov_h2 is not None and vertex.output is not None


def gain_difference(own: RegionGains, proof: RegionProof, input_scale_nm: float) -> float:
    """Largest relative difference of the law's gains from the proven feedback; k_z, which no proof has, is to be 0."""
    size = len(proof.feedback)
    proven = -np.array(proof.feedback) * proof.torque_scale_nm / np.array(proof.scale[:size])
    used = np.array([own.k_x_per_rad * input_scale_nm, own.k_v_s_per_rad * input_scale_nm, *own.memory])
    rest = abs(own.k_z_per_rad) + float(np.abs(used[size:]).sum())
    return float(np.abs(used[:size] / proven - 1.0).max()) + rest


def unproven_rad_s(law: LocalParameters, design: Design, region: RegionProof) -> float:
    """By how much the law uses the region's gains below or above the speeds of their proof, the more of both."""
    low = region.name == "low"
    used = (0.0, law.regions.overlap_to_rad_s) if low else (law.regions.overlap_from_rad_s, design.speed_max_rad_s)
    return float(max(region.speed_from_rad_s - used[0], used[1] - region.speed_to_rad_s, 0.0))
