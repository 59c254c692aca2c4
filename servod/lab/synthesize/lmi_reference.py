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

    Every inequality holds by `strict`, in scaled units. Each is handed over as one affine map of all unknowns: built
    of cvxpy's own blocks, reading them took it ten times as long as solving.
    """
    rows = _output_rows(region)
    size = disturbance_size(region)
    count_p, count_q = _entries(3), _entries(rows)

    def unknowns(x: Array) -> tuple[Array, Array, Array]:
        return _symmetric(x[:count_p], 3), x[count_p:-count_q][None], _symmetric(x[-count_q:], rows)

    def matrices(x: Array) -> list[Array]:
        p, y, q = unknowns(x)
        outputs = _outputs(region, p, y) / region.wishes.torque_weight
        found = [np.block([[q, outputs], [outputs.T, p]]), p]
        return found + [block for vertex in region.found for block in _blocks(vertex, region, size, parts, p, y)]

    count = count_p + 3 + count_q
    x, at_zero = cp.Variable(count), matrices(np.zeros(count))
    slopes = zip(*(matrices(unit) for unit in np.eye(count)), strict=True)
    constraints = []
    for offset, columns in zip(at_zero, slopes, strict=True):
        n = len(offset)
        slope = np.stack([(column - offset).ravel() for column in columns], axis=1)
        constraints.append(cp.reshape(slope @ x + offset.ravel(), (n, n), order="C") >> strict * np.eye(n))
    weights = np.concatenate([np.zeros(count_p + 3), _diagonal_weights(rows)])
    problem = cp.Problem(cp.Minimize(weights @ x), constraints)
    if not solved(problem, region.wishes.solver) or x.value is None:
        return None
    unit = size * region.wishes.torque_weight
    p, y, q = unknowns(np.asarray(x.value, dtype=np.float64))
    norm = unit * math.sqrt(max(float(problem.value), 0.0))
    return Solved(size**2 * p, size**2 * y[0], unit**2 * q, norm)


def _entries(size: int) -> int:
    return size * (size + 1) // 2


def _symmetric(entries: Array, size: int) -> Array:
    """The symmetric matrix of its upper triangle, row by row."""
    upper = np.zeros((size, size))
    upper[np.triu_indices(size)] = entries
    found: Array = upper + np.triu(upper, 1).T
    return found


def _diagonal_weights(size: int) -> Array:
    """Which of the entries stand on the diagonal."""
    rows, columns = np.triu_indices(size)
    found: Array = (rows == columns).astype(np.float64)
    return found


def disturbance_size(region: Region) -> float:
    """Largest entry of B_1 in scaled states: divided by it, P is of the size of one."""
    largest = max(float(np.abs(vertex.b1 / region.scale[:, None]).max()) for vertex in region.found)
    return largest / math.sqrt(RATE_PER_S)


def _output_rows(region: Region) -> int:
    return 1 if region.wishes.output is ReferenceOutput.SCALAR else 2


def _outputs(region: Region, p: Array, y: Array) -> Array:
    """(C' + D' K_u*) P, as in servod.lab.verify.reference_proof.output_rows."""
    w = region.wishes
    position = np.array([[0.0, w.position_weight * region.scale[1], 0.0]]) @ p
    torque = w.torque_weight * y
    return position + torque if w.output is ReferenceOutput.SCALAR else np.vstack([position, torque])


def _blocks(
    vertex: ContinuousVertex, region: Region, size: float, parts: frozenset[str], p: Array, y: Array
) -> list[Array]:
    """The matrices of one vertex that must be positive, by constraint: see servod.lab.verify.reference_proof."""
    w, scale = region.wishes, region.scale
    flow = (vertex.a * (scale / scale[:, None]) @ p + vertex.b2 / scale[:, None] @ y) / RATE_PER_S
    b1, both = vertex.b1 / scale[:, None] / size / math.sqrt(RATE_PER_S), flow + flow.T
    theta = float(np.arccos(w.least_damping))
    wide, skew = np.sin(theta) * both, np.cos(theta) * (flow - flow.T)
    known = {
        "norm": -np.block([[both, b1], [b1.T, -np.eye(b1.shape[1])]]),
        "decay": -both - 2.0 * w.least_decay_per_s / RATE_PER_S * p,
        "damping": -np.block([[wide, skew], [-skew, wide]]),
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
    why: bool = True,
) -> ReferenceAnswer:
    """The reference design of one region: the proof with its gains, or the clash, where `why` asks for it."""
    region = programme(friction, span, intervals, wishes or ReferenceWishes())
    solved = solve(region, frozenset(PARTS), strict)
    if solved is not None:
        return ReferenceAnswer(_proof(span, intervals, region, solved), solved.norm, ())
    return ReferenceAnswer(None, None, tuple(_clashes(span, region)) if why else ())


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
    clashes = []
    for part in PARTS:
        if solve(region, frozenset({part})) is not None:
            continue
        alone = [v.name for v in region.found if solve(region.only(v), frozenset({part})) is None]
        clashes += [f"{part}: {name}, by itself" for name in alone]
        if not alone:
            clashes.append(f"{part}: {span.name}: one Lyapunov matrix for all {len(region.found)} vertices")
    together = f"{span.name}: {', '.join(PARTS)} together over all {len(region.found)} vertices"
    return clashes or [together]
