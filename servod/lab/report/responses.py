"""Frequency and impulse responses of sampled systems, and of the axis before and after compensation.

Under the figures of the loop; stands on the linearised loop of servod.lab.verify, no solver.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from servod.formats.gains.design import Design, RegionProof, Vertex
from servod.formats.gains.parameters import LocalParameters, OutputObserver, RegionGains, VelocitySource
from servod.kernels.laws import LAWS
from servod.kernels.laws.state import N_STATES
from servod.lab.report.figure import Array
from servod.lab.verify.closed_loop import JointPoint, LinearBristle, LoopDeviation, joint_point, loops
from servod.lab.verify.law_slopes import LawSlopes, law_slopes
from servod.lab.verify.proof import closed
from servod.lab.verify.sampled import timing_of
from servod.lab.verify.steady_friction import steady_friction

Complex = NDArray[np.complex128]
Loop = tuple[Array, Array, Array]  # (A, column by which the torque command enters, row that gives the position)


def frequency_response(a: Array, b: Array, c: Array, period_s: float, frequencies_hz: Array) -> Complex:
    """c (zI - A)^-1 b at z = exp(2 pi i f T), for one input and one output."""
    z = np.exp(2j * np.pi * frequencies_hz * period_s)
    resolvent = np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, b.astype(complex)[None, :, None])
    response: Complex = np.asarray((c @ resolvent)[:, 0], dtype=np.complex128)
    return response


def impulse_response(a: Array, b: Array, c: Array, samples: int) -> Array:
    """Outputs c A^k b for k = 0, 1, ...: rows over time, a column for each output."""
    state, out = b.astype(np.float64), np.empty((samples, len(c)))
    for k in range(samples):
        out[k] = c @ state
        state = a @ state
    return out


def vertex_impulse(region: RegionProof, vertex: Vertex, samples: int) -> Array:
    """w -> xi = [alpha*x, beta*u] of one vertex under the region's feedback, in scaled units."""
    a, c = closed(region, vertex)
    return impulse_response(a, np.array(vertex.e), c, samples)


def before(design: Design, velocity: float) -> Loop:
    """The joint alone at `velocity` [rad/s], with delay and velocity filter, without any law."""
    nothing = LawSlopes(np.zeros((1 + N_STATES, 2 + N_STATES)), tuple(range(N_STATES)))
    return _position(*loops([_point(design, velocity)], nothing, timing_of(design))[:2])


def closed_loop_response(design: Design, law: LocalParameters, velocity: float, observer: bool) -> Loop:
    """The joint with the compensator (9) around it and no feedback; `observer`: with the law's output observer too.

    The friction state goes by the measured velocity here whatever the law chooses: driven by the reference it is a
    feed-forward, which no response of the axis to its torque can show.
    """
    slopes = law_slopes(LAWS["local"], compensation_only(law, observer).pack(), velocity, True, timing_of(design))
    return _position(*loops([_point(design, velocity)], slopes, timing_of(design))[:2])


def _position(a: Array, column: Array) -> Loop:
    """The one loop of a stack; the position is its first state."""
    row = np.zeros(a.shape[-1])
    row[0] = 1.0
    return a[0], column[0], row


def compensation_only(law: LocalParameters, observer: bool) -> LocalParameters:
    """The law without feedback and without l_i: what stays is the compensation of friction."""
    none = RegionGains(k_x_per_rad=0.0, k_v_s_per_rad=0.0)
    sets = [s.model_copy(update={"gain": 0.0}) for s in law.friction.sets]
    measured = {"sets": sets, "velocity": VelocitySource.MEASURED, "lead_s": 0.0}
    kept: OutputObserver | None = law.disturbance_observer if observer else None
    return law.model_copy(
        update={
            "regions": law.regions.model_copy(update={"low": none, "high": none}),
            "friction": law.friction.model_copy(update=measured),
            "disturbance_observer": kept,
            "hold_within_rad": 0.0,
        }
    )


def rigid(design: Design, frequencies_hz: Array) -> Complex:
    """1/(m s^2) with delay, lag and hold: the axis that a perfect compensation would leave, in rad/(N*m)."""
    friction, timing = steady_friction(design.model), timing_of(design)
    s = 2j * np.pi * frequencies_hz
    late = np.exp(-s * (timing.delay_s + 0.5 * timing.period_s)) / (1.0 + s * timing.lag_s)
    response: Complex = late / (friction.inertia * s**2)
    return response


def _point(design: Design, velocity: float) -> JointPoint:
    kind = LinearBristle.SLIDES if velocity else LinearBristle.STICKS
    return joint_point(steady_friction(design.model), velocity, kind, LoopDeviation())
