"""The design behind a gain set: model, intervals and the matrices that prove it; anyone can check the set alone.

Beside the data path: `servoctl synthesize` writes it, `servoctl verify` reads it; the daemon only carries it along.
Matrices are lists of rows. States of a region's matrices: [x, v_f, u_(k-1), ..., u_(k-n), v - v_f, z], each divided by
its `scale`; the reference mode has its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from typing import Annotated

from pydantic import ConfigDict, Field, model_validator

from servod.common.yaml import Strict
from servod.formats.model.axis_model import AxisModel

Share = Annotated[float, Field(ge=0.0, lt=0.9)]
Positive = Annotated[float, Field(gt=0.0)]
Row = list[float]
Matrix = list[Row]


class _Numbers(Strict):
    model_config = ConfigDict(strict=True)


class Uncertainty(Strict):
    """Half widths of the intervals in which the true axis lies, each a share of the model's value but the delay's."""

    inertia: Share = 0.05
    torque_gain: Share = 0.01
    stiffness: Share = Field(0.12, description="bristle stiffness c0")
    damping: Share = Field(0.2, description="bristle damping sigma1")
    dry: Share = Field(0.05, description="level of dry friction")
    slope: Share = Field(0.05, description="fall of the Stribeck curve beyond the level of dry friction")
    viscous: Share = 0.1
    delay_s: float = Field(20e-6, ge=0.0, le=0.01, description="half width in s: what a cycle jitters, at least")

    def scaled(self, factor: float) -> Uncertainty:
        """All half widths times `factor`, shares at most 0.85."""
        return Uncertainty(**{key: min(factor * value, 0.85) for key, value in self.model_dump().items()})


#: Keys of Uncertainty that are shares of a value of the model.
SHARES = tuple(name for name in Uncertainty.model_fields if name != "delay_s")


class Vertex(_Numbers):
    """One vertex of a region: the sampled joint, and the matrices that prove it; `name` says which ends it takes.

    `mode` names the polytope that it is a corner of (sliding or sticking) and with it the slack matrix.
    """

    name: str
    mode: str
    a: Matrix
    b: Row
    e: Row
    disc_centre: float
    disc_radius: Positive
    lyapunov_disc: Matrix = Field(description="Q")
    lyapunov_h2: Matrix | None = Field(None, description="P; None where the H2 norm does not count")
    output: Matrix | None = Field(None, description="W, trace = squared H2 norm bound")


class RegionProof(_Numbers):
    """Proof of one region: u = feedback*[x, v_f, u_(k-1), ...] in scaled units, a slack per mode, P and Q per vertex.

    H2 (de Oliveira, Geromel, Bernussou, IJC 75, 2002): [P - E E', A G; *, G + G' - P] > 0, [W, C G; *, G + G' - P] > 0
    with the loop closed; pole disc: [r Q, (A - c) G; *, r (G + G' - Q)] > 0.
    """

    name: str = Field(pattern="^(low|high)$")
    speed_from_rad_s: float
    speed_to_rad_s: float
    scale: Row
    torque_scale_nm: Positive
    position_weight: Positive = Field(description="alpha, on the scaled position error")
    torque_weight: Positive = Field(description="beta, on the scaled torque")
    feedback: Row
    slack: dict[str, Matrix] = Field(description="G, one for each mode")
    vertices: list[Vertex] = Field(min_length=1, max_length=64)

    @model_validator(mode="after")
    def _sizes_fit(self) -> RegionProof:
        n = len(self.scale)
        if not 0 < len(self.feedback) <= n:
            raise ValueError(f"feedback has {len(self.feedback)} entries, and scale names {n} states")
        for name, matrix in self._matrices():
            if [len(row) for row in matrix] != [n] * n:
                raise ValueError(f"{name} is not {n} by {n}, as scale has it")
        for vertex in self.vertices:
            if {len(vertex.b), len(vertex.e)} != {n}:
                raise ValueError(f"vertex {vertex.name}: b and e have {n} entries, as scale has")
            if vertex.mode not in self.slack:
                raise ValueError(f"vertex {vertex.name}: slack has no matrix for its mode {vertex.mode}")
            if vertex.output and [len(row) for row in vertex.output] != [2, 2]:
                raise ValueError(f"vertex {vertex.name}: output is not 2 by 2")
        return self

    def _matrices(self) -> Iterator[tuple[str, Matrix]]:
        """(where it stands, matrix) of all that have as many rows and columns as there are states."""
        yield from ((f"slack of {mode}", matrix) for mode, matrix in self.slack.items())
        for v in self.vertices:
            yield from ((f"vertex {v.name}: {key}", m) for key, m in (("a", v.a), ("lyapunov_disc", v.lyapunov_disc)))
            if v.lyapunov_h2 is not None:
                yield f"vertex {v.name}: lyapunov_h2", v.lyapunov_h2


class ReferenceForm(StrEnum):
    """How the equations (12), (15) are read: as physics has them, or to the letter."""

    CONSISTENT = "consistent"
    PRINTED = "printed"


class ReferenceOutput(StrEnum):
    """The output of (14): both outputs weighed as in the LQG problem that the text names, or their literal sum."""

    VECTOR = "vector"
    SCALAR = "scalar"


class ReferenceProof(_Numbers):
    """Proof of one region of the reference mode: P, Y = K_u* P and Q of (14), common to all vertices of (15).

    Every interval is [lower end, upper end]; the vertices are all their corners. States [z_hat, x, v] by `scale`.
    """

    name: str
    speed_from_rad_s: float
    speed_to_rad_s: float
    form: ReferenceForm = Field(ReferenceForm.CONSISTENT, strict=False)
    output: ReferenceOutput = Field(ReferenceOutput.VECTOR, strict=False)
    decays_per_s: Row = Field(description="a_i")
    stiffness_mismatch_nm_per_rad: Row = Field(description="dc_i")
    viscous_mismatch_nms_per_rad: Row = Field(description="dd_i")
    gains_l: Row = Field(description="l_i")
    input_scale_nm: Positive = Field(description="K")
    position_weight: Positive = Field(description="alpha")
    torque_weight: Positive = Field(description="beta")
    least_decay_per_s: float
    least_damping: Share
    scale: Row
    lyapunov: Matrix = Field(description="P")
    feedback_lyapunov: Row = Field(description="Y")
    bound: Matrix = Field(description="Q, trace = squared H2 norm bound")


class DesignMode(StrEnum):
    """The paper's continuous-time programme, or the one with delay and filter that is meant to run."""

    REFERENCE = "reference"
    DEPLOYED = "deployed"


class Design(_Numbers):
    """What a gain set was designed for, and its proofs."""

    mode: DesignMode = Field(strict=False)
    period_s: Positive
    velocity_cutoff_hz: Positive
    counts_per_turn: Annotated[float, Field(ge=0.0)]
    speed_max_rad_s: Positive
    torque_limit_nm: Positive | None = Field(None, description="of the axis; without: what its friction asks for")
    torque_rate_nm_per_s: Positive | None = Field(None, description="of the axis; without: not compared")
    accuracy: Share = Field(0.0, description="force tolerance between local sets, as a share")
    model: AxisModel = Field(strict=False)
    uncertainty: Uncertainty
    regions: list[RegionProof] = Field(default_factory=list, max_length=2)
    reference: list[ReferenceProof] = Field(default_factory=list, max_length=2, description="of the reference mode")
