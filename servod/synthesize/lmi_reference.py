"""The paper's programme (12)-(15) in its physically consistent form, continuous time: the reference mode.

Stands on cvxpy and the intervals. Kept to be compared with: it knows no delay, no velocity filter and no sample time,
so what it finds says little about the axis, and it often finds nothing. Then it names the vertices and the constraints
that clash. Consistent with (12): x' = (z_hat, x, v) with

    A_i = [-a, 0, 1; 0, 0, 1; -dc/m, -kappa/m, -dd/m],  B_2i = [l, 0, K/m],  B_1 = [1, 0; 0, 0; 0, 1/m],

the outputs [alpha x; beta u*], and Y = K_u* P, without which (14) is not jointly convex.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from servod.verify.sampled import Array
from servod.verify.steady_friction import SteadyFriction
from servod.verify.vertices import Span

STRICT = 1e-7
KAPPA_SHARE = 0.01  # kappa of (15), the small gain that provides a solution, as a share of c0
Found = tuple[tuple[float, float, float], float]  # (k_z, k_x, k_v) and the norm
SOLVED = ("optimal", "optimal_inaccurate")


@dataclass(frozen=True, slots=True)
class ReferenceWishes:
    """What (14) is asked for; mismatches are shares of c0 and of the viscous friction."""

    input_scale_nm: float = 0.1
    position_weight: float = 1.0
    input_weight: float = 0.01
    least_decay_per_s: float = 1.0
    least_damping: float = 0.1
    stiffness_mismatch: float = 0.2
    damping_mismatch: float = 0.5
    gains_l: tuple[float, float] = (0.0, 0.04)


@dataclass(frozen=True, slots=True)
class ContinuousVertex:
    """One vertex of (15)."""

    name: str
    a: Array
    b1: Array
    b2: Array


@dataclass(frozen=True, slots=True)
class ReferenceAnswer:
    """Gains (k_z, k_x, k_v) of (13) as negative feedback and the norm bound; None with what clashes."""

    gains: tuple[float, float, float] | None
    norm: float | None
    clashes: tuple[str, ...]


def vertices(
    friction: SteadyFriction, span: Span, decays: Sequence[float], w: ReferenceWishes
) -> list[ContinuousVertex]:
    """All ends of a_i over the region, of the mismatches and of l_i."""
    m, c0 = friction.inertia, friction.stiffness
    viscous = max(friction.viscous(span.to_rad_s), 1e-9 * c0)
    found = []
    for (a, c), d, gain in itertools.product(
        itertools.product(sorted({min(decays), max(decays)}), (-1.0, 1.0)), (-1.0, 1.0), sorted(set(w.gains_l))
    ):
        dc, dd = c * w.stiffness_mismatch * c0, d * w.damping_mismatch * viscous
        matrix = np.array([[-a, 0.0, 1.0], [0.0, 0.0, 1.0], [-dc / m, -KAPPA_SHARE * c0 / m, -dd / m]])
        b1 = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0 / m]])
        b2 = np.array([[gain], [0.0], [w.input_scale_nm / m]])
        name = f"{span.name}: a={a:.3g} dc={dc:.3g} dd={dd:.3g} l={gain:g}"
        found.append(ContinuousVertex(name, matrix, b1, b2))
    return found


def solve(found: Sequence[ContinuousVertex], w: ReferenceWishes, scale: Array, parts: frozenset[str]) -> Found | None:
    """(gains, norm) of the programme over `found` with the named constraints, or None when it is infeasible."""
    p, y = cp.Variable((3, 3), symmetric=True), cp.Variable((1, 3))
    q = cp.Variable((2, 2), symmetric=True)
    c = np.array([[0.0, w.position_weight * scale[1], 0.0]])
    outputs = cp.vstack([c @ p, w.input_weight * y])
    constraints = [cp.bmat([[q, outputs], [outputs.T, p]]) >> STRICT * np.eye(5), p >> STRICT * np.eye(3)]
    for vertex in found:
        constraints += _constraints(vertex, w, scale, parts, p, y)
    problem = cp.Problem(cp.Minimize(cp.trace(q)), constraints)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver="CLARABEL")
    except cp.error.SolverError:
        return None
    if problem.status not in SOLVED or p.value is None:
        return None
    k_z, k_x, k_v = (-np.asarray(y.value) @ np.linalg.inv(np.asarray(p.value)) / scale)[0].tolist()
    return (k_z, k_x, k_v), float(np.sqrt(max(problem.value, 0.0)))


def _constraints(
    vertex: ContinuousVertex, w: ReferenceWishes, scale: Array, parts: frozenset[str], p: Any, y: Any
) -> list[Any]:
    """The named constraints of one vertex: the first of (14), least decay, and the cone of the damping ratio."""
    flow = vertex.a * (scale / scale[:, None]) @ p + vertex.b2 / scale[:, None] @ y
    b1, both = vertex.b1 / scale[:, None], flow + flow.T
    theta = float(np.arccos(w.least_damping))
    wide, skew = np.sin(theta) * both, np.cos(theta) * (flow - flow.T)
    known = {
        "norm": -cp.bmat([[both, b1], [b1.T, -np.eye(2)]]) >> STRICT * np.eye(5),
        "decay": -both - 2.0 * w.least_decay_per_s * p >> STRICT * np.eye(3),
        "damping": -cp.bmat([[wide, skew], [-skew, wide]]) >> STRICT * np.eye(6),
    }
    return [known[part] for part in PARTS if part in parts]


PARTS = ("norm", "decay", "damping")


def reference(
    friction: SteadyFriction, span: Span, decays: Sequence[float], wishes: ReferenceWishes | None = None
) -> ReferenceAnswer:
    """The reference design of one region: gains of (13) as negative feedback, or the clash."""
    w = wishes or ReferenceWishes()
    found = vertices(friction, span, decays, w)
    position = friction.largest(span.to_rad_s) / friction.stiffness
    scale = np.array([position, position, position * np.sqrt(friction.stiffness / friction.inertia)])
    answer = solve(found, w, scale, frozenset(PARTS))
    if answer is not None:
        return ReferenceAnswer(answer[0], answer[1], ())
    return ReferenceAnswer(None, None, tuple(_clashes(found, w, scale)))


def _clashes(found: Sequence[ContinuousVertex], w: ReferenceWishes, scale: Array) -> list[str]:
    """Constraints that are infeasible by themselves, with the vertices that are so alone; else all of them together."""
    told = []
    for part in PARTS:
        if solve(found, w, scale, frozenset({part})) is not None:
            continue
        alone = [v.name for v in found if solve([v], w, scale, frozenset({part})) is None]
        told.append(f"{part}: " + ("; ".join(alone) if alone else f"one P for all {len(found)} vertices"))
    return told or [f"norm, decay and damping together over all {len(found)} vertices"]
