"""The paper's programme (12)-(15), continuous time: the reference mode's LMIs over one region.

Stands on cvxpy and the vertices. Kept to be compared with: it knows no delay, no velocity filter and no sample time,
so what it finds says little about the axis, and it often finds nothing. Then it names the vertices and the constraints
that clash. With Y = K_u* P, without which (14) is not jointly convex. The form is the physically consistent one or the
printed one, the output [alpha x; beta u*] or the printed sum (servod.formats.gains.design).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from servod.formats.gains.design import ReferenceForm, ReferenceOutput, ReferenceProof
from servod.lab.synthesize.solvers import solved
from servod.lab.verify.reference_proof import ContinuousVertex, Polytope, vertices
from servod.lab.verify.sampled import Array
from servod.lab.verify.steady_friction import SteadyFriction
from servod.lab.verify.vertices import Span

STRICT = 1e-6  # of the inequalities with states, time and disturbances scaled
RATE_PER_S = 1e3  # unit of time is its inverse
PARTS = ("norm", "decay", "damping")


@dataclass(frozen=True, slots=True)
class ReferenceWishes:
    """What (14) is asked for; `position_weight` is per rad, `torque_weight` per unit of u* = u/K."""

    input_scale_nm: float = 0.1
    position_weight: float = 1.0
    torque_weight: float = 0.01
    least_decay_per_s: float = 1.0
    least_damping: float = 0.1
    form: ReferenceForm = ReferenceForm.CONSISTENT
    output: ReferenceOutput = ReferenceOutput.VECTOR
    solver: str = "CLARABEL"


@dataclass(frozen=True, slots=True)
class ReferenceAnswer:
    """The proof of one region with its norm bound; None with what clashes."""

    proof: ReferenceProof | None
    norm: float | None
    clashes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Region:
    """One region's programme: vertices in SI units, the scales of the states, what is asked."""

    found: list[ContinuousVertex]
    scale: Array
    wishes: ReferenceWishes

    def only(self, vertex: ContinuousVertex) -> Region:
        """The same programme over one vertex."""
        return Region([vertex], self.scale, self.wishes)


@dataclass(frozen=True, slots=True)
class Solved:
    """P, Y and Q of (14) in scaled states, and the norm bound."""

    lyapunov: Array
    feedback_lyapunov: Array
    bound: Array
    norm: float


def solve(region: Region, parts: frozenset[str], strict: float = STRICT) -> Solved | None:
    """The programme over all vertices with the named constraints; None when it is infeasible.

    Every inequality holds by `strict`, in scaled units.
    """
    p, y = cp.Variable((3, 3), symmetric=True), cp.Variable((1, 3))
    outputs = _outputs(region, p, y) / region.wishes.torque_weight
    rows = outputs.shape[0]
    q = cp.Variable((rows, rows), symmetric=True)
    constraints = [cp.bmat([[q, outputs], [outputs.T, p]]) >> strict * np.eye(3 + rows), p >> strict * np.eye(3)]
    size = disturbance_size(region)
    for vertex in region.found:
        constraints += [
            block >> strict * np.eye(block.shape[0]) for block in _blocks(vertex, region, size, parts, p, y)
        ]
    problem = cp.Problem(cp.Minimize(cp.trace(q)), constraints)
    if not solved(problem, region.wishes.solver) or p.value is None:
        return None
    unit = size * region.wishes.torque_weight
    values = [np.asarray(value, dtype=np.float64) for value in (p.value, y.value[0], q.value)]
    norm = unit * math.sqrt(max(float(problem.value), 0.0))
    return Solved(size**2 * values[0], size**2 * values[1], unit**2 * values[2], norm)


def disturbance_size(region: Region) -> float:
    """Largest entry of B_1 in scaled states: divided by it, P is of the size of one."""
    largest = max(float(np.abs(vertex.b1 / region.scale[:, None]).max()) for vertex in region.found)
    return largest / math.sqrt(RATE_PER_S)


def _outputs(region: Region, p: Any, y: Any) -> Any:
    """(C' + D' K_u*) P, as in servod.lab.verify.reference_proof.output_rows."""
    w = region.wishes
    position = np.array([[0.0, w.position_weight * region.scale[1], 0.0]]) @ p
    torque = w.torque_weight * y
    return position + torque if w.output is ReferenceOutput.SCALAR else cp.vstack([position, torque])


def _blocks(vertex: ContinuousVertex, region: Region, size: float, parts: frozenset[str], p: Any, y: Any) -> list[Any]:
    """The matrices of one vertex that must be positive, by constraint: see servod.lab.verify.reference_proof."""
    w, scale = region.wishes, region.scale
    flow = (vertex.a * (scale / scale[:, None]) @ p + vertex.b2 / scale[:, None] @ y) / RATE_PER_S
    b1, both = vertex.b1 / scale[:, None] / size / math.sqrt(RATE_PER_S), flow + flow.T
    theta = float(np.arccos(w.least_damping))
    wide, skew = np.sin(theta) * both, np.cos(theta) * (flow - flow.T)
    known = {
        "norm": -cp.bmat([[both, b1], [b1.T, -np.eye(b1.shape[1])]]),
        "decay": -both - 2.0 * w.least_decay_per_s / RATE_PER_S * p,
        "damping": -cp.bmat([[wide, skew], [-skew, wide]]),
    }
    return [known[part] for part in PARTS if part in parts]


def programme(friction: SteadyFriction, span: Span, intervals: Polytope, w: ReferenceWishes) -> Region:
    """The programme of one region over all corners of its intervals."""
    found = vertices(span.name, intervals, friction.inertia, friction.stiffness, w.input_scale_nm, w.form)
    position = friction.largest(span.to_rad_s) / friction.stiffness
    inertia = 1.0 if w.form is ReferenceForm.PRINTED else friction.inertia  # (15) as printed forgets it
    speed = position * np.sqrt(friction.stiffness / inertia)
    return Region(found, np.array([position, position, speed]), w)


def reference(
    friction: SteadyFriction,
    span: Span,
    intervals: Polytope,
    wishes: ReferenceWishes | None = None,
    strict: float = STRICT,
) -> ReferenceAnswer:
    """The reference design of one region: the proof with its gains, or the clash."""
    region = programme(friction, span, intervals, wishes or ReferenceWishes())
    solved = solve(region, frozenset(PARTS), strict)
    if solved is not None:
        return ReferenceAnswer(_proof(span, intervals, region, solved), solved.norm, ())
    return ReferenceAnswer(None, None, tuple(_clashes(span, region)))


def _proof(span: Span, intervals: Polytope, region: Region, solved: Solved) -> ReferenceProof:
    """The region's proof as plain numbers."""
    w = region.wishes
    return ReferenceProof(
        name=span.name,
        speed_from_rad_s=span.from_rad_s,
        speed_to_rad_s=span.to_rad_s,
        form=w.form,
        output=w.output,
        decays_per_s=list(intervals.decays),
        stiffness_mismatch_nm_per_rad=list(intervals.stiffness),
        viscous_mismatch_nms_per_rad=list(intervals.viscous),
        gains_l=list(intervals.gains_l),
        input_scale_nm=w.input_scale_nm,
        position_weight=w.position_weight,
        torque_weight=w.torque_weight,
        least_decay_per_s=w.least_decay_per_s,
        least_damping=w.least_damping,
        scale=region.scale.tolist(),
        lyapunov=solved.lyapunov.tolist(),
        feedback_lyapunov=solved.feedback_lyapunov.tolist(),
        bound=solved.bound.tolist(),
    )


def _clashes(span: Span, region: Region) -> Sequence[str]:
    """Constraints that are infeasible by themselves, with the vertices that are so alone; else all of them together."""
    told = []
    for part in PARTS:
        if solve(region, frozenset({part})) is not None:
            continue
        alone = [v.name for v in region.found if solve(region.only(v), frozenset({part})) is None]
        told += [f"{part}: {name}, by itself" for name in alone]
        if not alone:
            told.append(f"{part}: {span.name}: one Lyapunov matrix for all {len(region.found)} vertices")
    together = f"{span.name}: {', '.join(PARTS)} together over all {len(region.found)} vertices"
    return told or [together]
