"""The LMI programme of the deployed mode: sampled polytopic H2 with a pole disc, one Lyapunov matrix per vertex.

Stands on cvxpy; in: scaled vertices (servod.lab.verify.vertices), out: feedback of [x, v_f, u_(k-1), ...] and the
matrices that prove it. The bristle either sticks or slides: two polytopes, each with its own slack, one feedback for
both (one slack for both was infeasible for every gain). Neither the joint's true velocity nor its bristle is fed back,
so the slack needs a structure that lets R = K G be linear: G = [G1 M, G1 X; G2, G3] and R = [R1 M, R1 X] with M and X
fixed gives K = R1 inv(G1). Block triangular slack (M = 1, X = 0) was tried first and loses most of Omega_H. Here M and
X come from an analysis with the last feedback and full slack, in turn: neither step can lose what the other has won.

H2 norm, decay and damping count where the axis performs. Where the Stribeck curve falls, the joint is unstable with
poles beyond 150 1/s, and the velocity filter and the delay leave room for stability alone (a slow disc): asking for
decay there too costs two thirds of the position gain everywhere.

The H2 bound alone does not say which slack: where 1e-7 of the bound is 1e-3 of the slack, a solver that stops at 1e-8
leaves the gain of the oldest command open by 5e-3, another one for each processor. Tighter tolerances do not close it:
in Omega_L the solver then gives up at gains 6 % apart. So the slack is chosen: of all that reach the bound the one next
to the Lyapunov matrices, which for one vertex alone is the exact solution, and of those the smallest. Rounding then
moves gains by 1e-6, and the guide is a better one: 4 % less squared H2 norm in Omega_H, 0.2 % less in Omega_L. The size
alone as second aim costs 3 % there, and 14 % of the position gain; nearness alone leaves Omega_L as open as it was.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np

from servod.formats.gains.design import Design, RegionProof
from servod.lab.synthesize.solvers import solved
from servod.lab.verify.closed_loop import LinearBristle, LoopDeviation, joint_point
from servod.lab.verify.proof import scaled
from servod.lab.verify.sampled import Array, timing_of
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import VertexJoint, ends, known_commands

EPSILON = 1e-8  # strictness of the inequalities in scaled states
PROOF_EPSILON = 1e-5  # of the proof that is kept: what rounding in a file cannot turn
#: What choosing the slack weighs against the squared H2 norm: its distance to the Lyapunov matrices, and its size.
NEARNESS, SIZE = 1e-3, 1e-7
ROUNDS = 1  # a second one wins less than 2 % of the H2 norm
#: Rounds in which the turning vertices come into their discs, each by this much of radius, seen from this much more.
TURN_ROUNDS, TURN_STEP, TURN_ROOM = 5, 0.04, 1.003
POSITIONS, VELOCITIES = -np.geomspace(0.01, 3.0, 14), -np.geomspace(0.3, 20.0, 16)
MEMORY = (0.0, 0.25, 0.5)


@dataclass(frozen=True, slots=True)
class Programme:
    """One region in scaled states: vertices (stacked), weights alpha and beta, and a pole disc for each vertex.

    `modes` says which slack a vertex has, `performs` where the H2 norm counts.
    """

    modes: list[str]
    performs: list[bool]
    a: Array
    b: Array
    e: Array
    position_weight: float
    torque_weight: float
    discs: list[tuple[float, float]]
    solver: str = "CLARABEL"
    fed: int = 2

    def only(self, *modes: str) -> Programme:
        """The same programme over the vertices of some modes."""
        i = [j for j, m in enumerate(self.modes) if m in modes]
        return replace(
            self,
            modes=[self.modes[j] for j in i],
            performs=[self.performs[j] for j in i],
            discs=[self.discs[j] for j in i],
            a=self.a[i],
            b=self.b[i],
            e=self.e[i],
        )

    def turning_within(self, radius: float) -> Programme:
        """The same programme with another radius of the discs of turning vertices."""
        pairs = zip(self.modes, self.discs, strict=True)
        return replace(self, discs=[(0.0, radius) if mode == "turning" else disc for mode, disc in pairs])


@dataclass(frozen=True, slots=True)
class Solution:
    """Feedback of the first states in scaled units, and its proof."""

    feedback: Array
    slack: dict[str, Array]
    outputs: list[Array | None]
    lyapunov_h2: list[Array | None]
    lyapunov_disc: list[Array]

    @property
    def h2_bound(self) -> float:
        """Bound of the H2 norm over all vertices, in scaled units."""
        return float(np.sqrt(max(np.trace(w) for w in self.outputs if w is not None)))

    def upper_slack(self) -> dict[str, Array]:
        """[M, X] of each mode: the upper rows of its slack, seen from the first mode's G1."""
        n = len(self.feedback)
        first = next(iter(self.slack.values()))[:n, :n]
        return {
            mode: np.asarray(np.linalg.solve(first, slack[:n]), dtype=np.float64) for mode, slack in self.slack.items()
        }


class _Unknowns:
    """Slacks, R and W of one programme: with the feedback fixed (analysis) or open (synthesis along `upper_slack`)."""

    def __init__(self, p: Programme, feedback: Array | None, upper_slack: dict[str, Array] | None) -> None:
        size = p.a.shape[-1]
        self.outputs = [cp.Variable((2, 2), symmetric=True) if performs else None for performs in p.performs]
        self.h2 = [cp.Variable((size, size), symmetric=True) if performs else None for performs in p.performs]
        self.disc = [cp.Variable((size, size), symmetric=True) for _ in p.modes]
        self.upper, self.row = cp.Variable((p.fed, p.fed)), cp.Variable((1, p.fed))
        self.slack: dict[str, Any] = {}
        self.r: dict[str, Any] = {}
        for mode in dict.fromkeys(p.modes):
            if upper_slack is None:
                assert feedback is not None
                self.slack[mode] = cp.Variable((size, size))
                self.r[mode] = np.concatenate([feedback, np.zeros(size - p.fed)])[None, :] @ self.slack[mode]
            else:
                self.slack[mode] = cp.vstack([self.upper @ upper_slack[mode], cp.Variable((size - p.fed, size))])
                self.r[mode] = self.row @ upper_slack[mode]

    def spread(self, p: Programme, in_disc: bool) -> Any:
        """What chooses one of all slacks that reach the same bound: see the head of this file. Strictly convex."""
        lyapunov = [(mode, x) for mode, x in zip(p.modes, self.h2, strict=True) if x is not None]
        judged = [in_disc or not performs for performs in p.performs]
        lyapunov += [(mode, x) for mode, x, used in zip(p.modes, self.disc, judged, strict=True) if used]
        apart = sum(cp.sum_squares(x - self.slack[mode]) for mode, x in lyapunov)
        sizes = sum(cp.sum_squares(x) for x in [*self.slack.values(), *(x for _, x in lyapunov)])
        return NEARNESS * apart + SIZE * sizes

    def gain(self) -> Array:
        """The feedback after a synthesis."""
        solved: Array = np.linalg.solve(np.asarray(self.upper.value).T, np.asarray(self.row.value)[0])
        return solved


def _positive(blocks: list[list[Any]], size: int, strictness: float) -> Any:
    return cp.bmat(blocks) >> strictness * np.eye(size)


def _h2_constraints(p: Programme, i: int, u: _Unknowns, moved: Any, strictness: float) -> list[Any]:
    """The two H2 inequalities of vertex i: servod.lab.verify.proof.h2_state_block and h2_output_block."""
    size = p.a.shape[-1]
    slack, h2 = u.slack[p.modes[i]], u.h2[i]
    both = slack + slack.T
    pick = np.zeros((2, size))
    pick[0, 0] = p.position_weight
    seen = pick @ slack + np.array([[0.0], [p.torque_weight]]) @ u.r[p.modes[i]]
    return [
        _positive([[h2 - np.outer(p.e[i], p.e[i]), moved], [moved.T, both - h2]], 2 * size, strictness),
        _positive([[u.outputs[i], seen], [seen.T, both - h2]], size + 2, strictness),
    ]


def _vertex_constraints(p: Programme, i: int, u: _Unknowns, in_disc: bool, strictness: float) -> list[Any]:
    """All inequalities of vertex i; without `in_disc` stability is enough where the H2 norm counts."""
    slack, disc = u.slack[p.modes[i]], u.disc[i]
    moved = p.a[i] @ slack + p.b[i][:, None] @ u.r[p.modes[i]]
    both = slack + slack.T
    centre, radius = p.discs[i]
    found = _h2_constraints(p, i, u, moved, strictness) if p.performs[i] else []
    if in_disc or not p.performs[i]:
        shifted = moved - centre * slack
        blocks = [[radius * disc, shifted], [shifted.T, radius * (both - disc)]]
        found.append(_positive(blocks, 2 * p.a.shape[-1], strictness))
    return found


def solve(
    p: Programme,
    feedback: Array | None,
    upper_slack: dict[str, Array] | None,
    in_disc: bool = True,
    strictness: float = EPSILON,
) -> Solution | None:
    """One convex programme: analysis of `feedback`, or synthesis along `upper_slack`; None when infeasible."""
    u = _Unknowns(p, feedback, upper_slack)
    constraints = [c for i in range(len(p.a)) for c in _vertex_constraints(p, i, u, in_disc, strictness)]
    cost = sum(cp.trace(w) for w in u.outputs if w is not None)
    problem = cp.Problem(cp.Minimize(cost + u.spread(p, in_disc)), constraints)
    if not solved(problem, p.solver) or next(iter(u.slack.values())).value is None:
        return None
    return Solution(
        u.gain() if feedback is None else feedback,
        {mode: np.asarray(slack.value) for mode, slack in u.slack.items()},
        [None if w is None else np.asarray(w.value) for w in u.outputs],
        [None if x is None else np.asarray(x.value) for x in u.h2],
        [np.asarray(x.value) for x in u.disc] if in_disc else [],
    )


def first_feedback(p: Programme) -> Array:
    """Feedback of the grid that keeps the largest pole over all vertices smallest: where the rounds start."""
    size = p.a.shape[-1]
    best, best_radius = np.zeros(p.fed), np.inf
    for share, position in itertools.product(MEMORY, POSITIONS):
        rows = np.zeros((len(VELOCITIES), 1, 1, size))
        rows[:, 0, 0, 0] = position
        rows[:, 0, 0, 1] = VELOCITIES
        rows[:, 0, 0, 2 : p.fed] = -share
        loops = p.a[None] + p.b[None, :, :, None] * rows
        radii = np.abs(np.linalg.eigvals(loops)).max(axis=2)
        radius = radii.max(axis=1) + radii.mean(axis=1)
        j = int(radius.argmin())
        if radius[j] < best_radius:
            best, best_radius = rows[j, 0, 0, : p.fed].copy(), float(radius[j])
    return best


def synthesise(p: Programme) -> Solution | None:
    """Feedback with the least summed H2 norms that the rounds reach, proven over all vertices; None when infeasible.

    Only sliding vertices shape the feedback, and turning ones where there are any: stuck on its bristle, which is far
    stiffer than any feedback, the joint is proven afterwards. For the others the synthesis is the proof as well.
    """
    best = shaped(p.only("sliding"))
    if best is not None and "turning" in p.modes:
        best = turned(p, best)
    if best is None or "sticking" not in p.modes:
        return best
    stuck = solve(p.only("sticking"), best.feedback, None, strictness=PROOF_EPSILON)
    return None if stuck is None else both(p, best, stuck)


def shaped(shaping: Programme) -> Solution | None:
    """Feedback from the grid's start in rounds of analysis and synthesis.

    The start need not keep the disc; a round without it is taken where the disc asks too much.
    """
    last = solve(shaping, first_feedback(shaping), None, in_disc=False)
    for _ in range(ROUNDS + 1):
        if last is None:
            return None
        better = solve(shaping, None, last.upper_slack(), strictness=PROOF_EPSILON)
        if better is not None:
            return better
        plain = solve(shaping, None, last.upper_slack(), in_disc=False)
        last = None if plain is None else solve(shaping, plain.feedback, None, in_disc=False)
    return None


def turned(p: Programme, found: Solution) -> Solution | None:
    """`found`, changed until it holds the joint whose bristle is turned over too; None when that is not reached.

    A joint that is unstable under the feedback so far gives no guide, so its disc shrinks from what holds it now.
    """
    shaping, wanted = p.only("sliding", "turning"), p.discs[p.modes.index("turning")][1]
    for _ in range(TURN_ROUNDS):
        reach = largest_pole(p.only("turning"), found.feedback)
        if reach <= wanted:
            return found
        guide = solve(shaping.turning_within(TURN_ROOM * reach), found.feedback, None)
        radius = max(wanted, reach - TURN_STEP)
        better = guide and solve(shaping.turning_within(radius), None, guide.upper_slack(), strictness=PROOF_EPSILON)
        if better is None:
            return None
        found = better
    return None


def largest_pole(p: Programme, feedback: Array) -> float:
    """Largest pole magnitude of the vertices under `feedback` of their first states."""
    row = np.concatenate([feedback, np.zeros(p.a.shape[-1] - p.fed)])
    return float(np.abs(np.linalg.eigvals(p.a + p.b[:, :, None] * row)).max())


def both(p: Programme, sliding: Solution, sticking: Solution) -> Solution:
    """One proof of two: no inequality has vertices of both modes in it, so each polytope is proven by itself."""
    parts = {"sliding": sliding, "sticking": sticking}

    def in_order(name: str) -> list[Any]:
        """The matrices `name` of all vertices in their order."""
        left = {mode: iter(getattr(part, name)) for mode, part in parts.items()}
        return [next(left[mode]) for mode in p.modes]

    return Solution(
        sliding.feedback,
        sliding.slack | sticking.slack,
        in_order("outputs"),
        in_order("lyapunov_h2"),
        in_order("lyapunov_disc"),
    )


# --- The bristle being turned over -----------------------------------------------------------------------------------
# Joints that guide the feedback beside the vertices, and are no part of the proof: the bristle being turned over. After
# a reversal a bristle is twice as stiff for milliseconds. The certificate judges that at every speed; a feedback made
# for a steep fall of friction alone is too much for it there.


#: (centre, radius) asked for: stable, no more, for it lasts for milliseconds.
TURNING_DISC = 0.0, 0.999


def turned_bristle(
    design: Design, proof: RegionProof, speed_rad_s: float
) -> tuple[list[VertexJoint], Array, Array, Array]:
    """The turned bristle at `speed_rad_s` both ways, where it rings most, with its scaled (A, B, E)."""
    friction, u, found = steady_friction(design.model), design.uncertainty, []
    for side, damping in itertools.product((1.0, -1.0), ends(u.damping)):
        corner = LoopDeviation(
            1.0 - u.inertia, 1.0 + u.torque_gain, 1.0 + u.stiffness, damping, viscous=1.0 - u.viscous
        )
        matrices = joint_point(friction, side * speed_rad_s, LinearBristle.TURNS, corner).matrices()
        found.append(VertexJoint(f"turning {side * speed_rad_s:g} {damping:g}", "turning", False, *matrices))
    return found, *scaled(found, with_shortest_delay(design), proof)


def with_shortest_delay(design: Design) -> Design:
    """`design` with the shortest delay of its interval, if as many commands are on their way then: the loop's states.

    A turned bristle rings faster than the loop's phase crossover, where less delay is less stable.
    """
    model = design.model
    shorter = model.model_copy(update={"delay_s": max(model.delay_s - design.uncertainty.delay_s, 0.0)})
    early = design.model_copy(update={"model": shorter})
    same = known_commands(timing_of(early).as_delay) == known_commands(timing_of(design).as_delay)
    return early if same else design
