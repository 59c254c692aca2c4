"""The deployed mode: from an axis model with intervals to a gain set with feedback for both regions and their proofs.

Stands on the LMIs and the local sets. What cannot be reached is explained beside it, in `infeasible`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from servod.formats.gains.design import Design, DesignMode, RegionProof, Uncertainty, Vertex
from servod.formats.gains.parameters import RegionGains
from servod.formats.model.axis_model import AxisModel
from servod.lab.synthesize.lmi_deployed import TURNING_DISC, Programme, Solution, synthesise, turned_bristle
from servod.lab.synthesize.regions import OVERLAP_RAD_S, delay_refusal, pole_disc
from servod.lab.verify.proof import region_margin, scaled, scaled_vertices
from servod.lab.verify.sampled import Array, timing_of
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction
from servod.lab.verify.vertices import Span, fed_commands, joints, known_commands

#: Cut-offs of the velocity filter that are tried, the quietest first; above 800 Hz the encoder shakes the torque.
CUTOFFS_HZ = (300.0, 500.0, 800.0)
#: Those of an encoder so coarse that at 300 Hz each of its steps is half of the friction.
COARSE_CUTOFFS_HZ, COARSE_COUNTS = (150.0, 300.0, 500.0), 2.0**18
#: Pole radii asked for where the Stribeck curve falls, best first.
SLOW_DISCS = (0.985, 0.998)
#: Torque costs these shares of its weight in Omega_L, the first that is feasible: where the bristle holds the joint,
#: more gain risks little, but with two cycles of delay too much of it shakes the joint on its bristle.
LOW_TORQUE_SHARES = (0.6, 2.0)
#: Position error counts with these shares of its weight once the H2 norm counts where friction falls as well: what that
#: costs in margin where the bristle is turned over, less position gain gives back.
FALLING_POSITION_SHARES = (1.0, 0.6)
POSITION_BANDWIDTH_RAD_S = 120.0  # sets the scale of positions, and with it what alpha and beta mean


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked of a design; speeds in rad/s."""

    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    period_s: float = 0.001
    cutoff_hz: float | None = None  # of the velocity filter; None = the lowest that is feasible
    counts_per_turn: float = 2.0**20
    torque_limit_nm: float | None = None  # of the axis
    torque_rate_nm_per_s: float | None = None  # of the axis
    speed_max: float = 0.5
    overlap: tuple[float, float] = OVERLAP_RAD_S
    position_weight: float = 1.0
    torque_weight: float = 0.3  # a tenth of it costs half of the disk margin, ten times as much the position gain
    least_decay_per_s: float = 5.0
    least_damping: float = 0.02  # of all poles, up to half the sample rate: more forbids the feedback of past commands
    slow_disc: float | None = None  # pole radius where friction falls; None = the least that is feasible
    h2_where_it_falls: bool = False  # the H2 norm counts there too: more velocity gain, for curves that fall steeply
    solver: str = "CLARABEL"

    @property
    def cutoffs_hz(self) -> tuple[float, ...]:
        """Cut-offs of the velocity filter to try, in their order."""
        if self.cutoff_hz is not None:
            return (self.cutoff_hz,)
        return COARSE_CUTOFFS_HZ if 0.0 < self.counts_per_turn <= COARSE_COUNTS else CUTOFFS_HZ

    @property
    def spans(self) -> tuple[Span, Span]:
        """Omega_L and Omega_H, which share the overlap."""
        return Span("low", 0.0, self.overlap[1]), Span("high", self.overlap[0], self.speed_max)

    def choices(self) -> Iterator[Wishes]:
        """What was left open, narrowed: every cut-off with every pole radius where friction falls, best first."""
        for cutoff in self.cutoffs_hz:
            for slow in (self.slow_disc,) if self.slow_disc else SLOW_DISCS:
                yield replace(self, cutoff_hz=cutoff, slow_disc=slow)

    def steadier(self) -> Iterator[Wishes]:
        """The same wishes with the H2 norm at every vertex, for a joint whose friction falls too steeply without."""
        for share in FALLING_POSITION_SHARES:
            yield replace(self, h2_where_it_falls=True, position_weight=share * self.position_weight)


def empty_design(model: AxisModel, wishes: Wishes, cutoff_hz: float) -> Design:
    """The design without its proofs."""
    return Design(
        mode=DesignMode.DEPLOYED,
        period_s=wishes.period_s,
        velocity_cutoff_hz=cutoff_hz,
        counts_per_turn=wishes.counts_per_turn,
        speed_max_rad_s=wishes.speed_max,
        torque_limit_nm=wishes.torque_limit_nm,
        torque_rate_nm_per_s=wishes.torque_rate_nm_per_s,
        model=model,
        uncertainty=wishes.uncertainty,
    )


def scales(friction: SteadyFriction, design: Design) -> tuple[list[float], float]:
    """(scale of each state, scale of torques): the largest friction, and the deflection that it makes."""
    torque = friction.largest(design.speed_max_rad_s)
    position = torque / (friction.inertia * POSITION_BANDWIDTH_RAD_S**2)
    speed = position * POSITION_BANDWIDTH_RAD_S
    commands = known_commands(timing_of(design).as_delay)
    return [position, speed, *[torque] * commands, speed, torque / friction.stiffness], torque


def programme(design: Design, proof: RegionProof, wishes: Wishes) -> Programme:
    """The LMI programme of one region, over the vertices that verification will make again, and guides beside them."""
    friction = steady_friction(design.model)
    span = Span(proof.name, proof.speed_from_rad_s, proof.speed_to_rad_s)
    found = joints(friction, span, wishes.uncertainty)
    a, b, e = scaled(found, design, proof)
    if wishes.h2_where_it_falls and not span.holds_rest:
        turning_joints, *beside = turned_bristle(design, proof, wishes.overlap[1])
        found = found + turning_joints
        a, b, e = (np.concatenate(pair) for pair in zip((a, b, e), beside, strict=True))
    disc = pole_disc(wishes.least_decay_per_s, wishes.least_damping, wishes.period_s)
    ringing = 0.0, math.exp(-wishes.least_decay_per_s * wishes.period_s)  # its bristle's damping is the joint's own
    falling = 0.0, wishes.slow_disc or SLOW_DISCS[-1]
    discs = {"sticking": ringing, "turning": TURNING_DISC}
    return Programme(
        [j.mode for j in found],
        [j.performs or (wishes.h2_where_it_falls and j.mode == "sliding") for j in found],
        a,
        b,
        e,
        proof.position_weight,
        proof.torque_weight,
        [discs.get(j.mode, disc if j.performs else falling) for j in found],
        wishes.solver,
        2 + fed_commands(timing_of(design).as_delay),
    )


def bare_proof(design: Design, span: Span, wishes: Wishes, torque_share: float = 1.0) -> RegionProof:
    """A region's frame: speeds, scales and weights, with a vertex list still to come."""
    scale, torque = scales(steady_friction(design.model), design)
    return RegionProof.model_construct(
        name=span.name,
        speed_from_rad_s=span.from_rad_s,
        speed_to_rad_s=span.to_rad_s,
        scale=scale,
        torque_scale_nm=torque,
        position_weight=wishes.position_weight,
        torque_weight=wishes.torque_weight * torque_share,
        feedback=[],
        slack={},
        vertices=[],
    )


def _rows(matrix: Array | None) -> list[list[float]] | None:
    return None if matrix is None else [[float(x) for x in row] for row in matrix]


def proven(design: Design, frame: RegionProof, p: Programme, solution: Solution) -> RegionProof:
    """The region's proof with all matrices as plain numbers."""
    found, _, _, _ = scaled_vertices(design, frame)
    vertices = [
        Vertex(
            name=found[i].name,
            mode=p.modes[i],
            a=_rows(p.a[i]) or [],
            b=p.b[i].tolist(),
            e=p.e[i].tolist(),
            disc_centre=p.discs[i][0],
            disc_radius=p.discs[i][1],
            lyapunov_disc=_rows(solution.lyapunov_disc[i]) or [],
            lyapunov_h2=_rows(solution.lyapunov_h2[i]),
            output=_rows(solution.outputs[i]),
        )
        for i in range(len(found))
    ]
    proof_modes = {joint.mode for joint in found}  # what guided the solution beside them is no part of the proof
    slack = {mode: _rows(matrix) or [] for mode, matrix in solution.slack.items() if mode in proof_modes}
    solved = {"feedback": solution.feedback.tolist(), "slack": slack, "vertices": vertices}
    return RegionProof.model_validate(frame.model_dump() | solved)


def region(design: Design, span: Span, wishes: Wishes) -> RegionProof | None:
    """Feedback and proof of one region; None when the programme is infeasible or its proof does not hold."""
    for share in LOW_TORQUE_SHARES if span.holds_rest else (1.0,):
        frame = bare_proof(design, span, wishes, share)
        p = programme(design, frame, wishes)
        solution = synthesise(p)
        if solution is None:
            continue
        proof = proven(design, frame, p, solution)
        if region_margin(proof)[0] > 0.0:
            return proof
    return None


def regions(model: AxisModel, wishes: Wishes) -> Design | None:
    """Both regions at the first feasible choice of what `wishes` leaves open; None when there is none."""
    low, high = wishes.spans
    for choice in () if delay_refusal(model, wishes.period_s) else wishes.choices():
        assert choice.cutoff_hz is not None
        design = empty_design(model, choice, choice.cutoff_hz)
        hard = region(design, high, choice)
        easy = None if hard is None else region(design, low, choice)
        if hard is not None and easy is not None:
            return design.model_copy(update={"regions": [easy, hard]})
    return None


def designs(model: AxisModel, wishes: Wishes) -> Iterator[Design]:
    """Every design, best choice first, each before the ones that are steadier where friction falls."""
    for choice in wishes.choices():
        for wish in (choice, *choice.steadier()):
            design = regions(model, wish)
            if design is not None:
                yield design
            elif not wish.h2_where_it_falls:
                break


def region_gains(proof: RegionProof, input_scale_nm: float) -> RegionGains:
    """The law's gains from the scaled feedback: u = -K*(k_x*x + k_v*v_f) - sum k_u(i)*u(k-i)."""
    gains = [-proof.torque_scale_nm * k / s for k, s in zip(proof.feedback, proof.scale, strict=False)]
    position, speed = (gain / input_scale_nm for gain in gains[:2])
    return RegionGains(k_x_per_rad=position, k_v_s_per_rad=speed, k_u=gains[2:])
