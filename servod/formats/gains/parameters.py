"""Parameters of each control law as they stand in a gain set: keys with units, ranges, and packing for the kernels.

Beside the data path: read once, packed into plain floats, then never touched again in a cycle.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, model_validator

from servod.common.yaml import Strict
from servod.kernels.laws import MAX_SETS, local
from servod.kernels.laws.pd import PdGains
from servod.kernels.laws.pd_dob import PdDobGains
from servod.kernels.laws.pd_lugre import PdLugreGains
from servod.kernels.laws.position import MAX_WAVES, PositionTorques
from servod.kernels.laws.weights import Sets, Shape

Gain = Annotated[float, Field(ge=0.0, le=1e6)]
Inertia = Annotated[float, Field(gt=0.0, le=1e4)]
Torque = Annotated[float, Field(gt=0.0, le=1e5)]
Width = Annotated[
    float,
    Field(ge=0.0, le=1.0, description="with the reference at rest and less error than this, nothing integrates"),
]
# Sets are sealed and certified by their hash. A key that comes later is None where it is missing, and so out of the
# hash; with another default every set of an earlier version would read as changed.


class WeightShape(StrEnum):
    """Weighting functions by name; see servod.kernels.laws.weights."""

    LINEAR = "linear"
    COSINE = "cosine"
    GAUSSIAN = "gaussian"


class VelocitySource(StrEnum):
    """Whose velocity drives the friction state and the schedules of the local law."""

    MEASURED = "measured"
    REFERENCE = "reference"
    CORRECTED_REFERENCE = "corrected_reference"


#: What the kernel calls them.
_SOURCES: Mapping[VelocitySource, float] = {
    VelocitySource.MEASURED: local.MEASURED,
    VelocitySource.REFERENCE: local.REFERENCE,
    VelocitySource.CORRECTED_REFERENCE: local.CORRECTED,
}


class PdParameters(Strict):
    """PD feedback, with optional feed-forward of the reference acceleration."""

    law: Literal["pd"]
    position_gain_nm_per_rad: Gain = Field(description="K_P")
    velocity_gain_nms_per_rad: Gain = Field(description="K_D")
    feedforward_inertia_kg_m2: float = Field(0.0, ge=0.0, le=1e4, description="0: no feed-forward")

    def pack(self) -> tuple[float, ...]:
        """Parameters in the order that the kernel reads."""
        return PdGains(
            k_p=self.position_gain_nm_per_rad,
            k_d=self.velocity_gain_nms_per_rad,
            feedforward_inertia=self.feedforward_inertia_kg_m2,
        )


class PdDobParameters(Strict):
    """PD with a disturbance observer on nominal inertia and viscous friction."""

    law: Literal["pd_dob"]
    position_gain_nm_per_rad: Gain = Field(description="K_P")
    velocity_gain_nms_per_rad: Gain = Field(description="K_D")
    feedforward_inertia_kg_m2: float = Field(0.0, ge=0.0, le=1e4)
    bandwidth_rad_s: float = Field(gt=0.0, le=2000.0)
    inertia_kg_m2: Inertia
    viscous_nms_per_rad: float = Field(0.0, ge=0.0, le=1e4)
    disturbance_limit_nm: Torque
    hold_within_rad: Width = 0.0

    def pack(self) -> tuple[float, ...]:
        """Parameters in the order that the kernel reads."""
        return PdDobGains(
            k_p=self.position_gain_nm_per_rad,
            k_d=self.velocity_gain_nms_per_rad,
            feedforward_inertia=self.feedforward_inertia_kg_m2,
            bandwidth=self.bandwidth_rad_s,
            inertia=self.inertia_kg_m2,
            viscous=self.viscous_nms_per_rad,
            limit=self.disturbance_limit_nm,
            hold_within=self.hold_within_rad,
        )


class PdLugreParameters(Strict):
    """PD with the LuGre observer (18)."""

    law: Literal["pd_lugre"]
    position_gain_nm_per_rad: Gain = Field(description="K_P")
    velocity_gain_nms_per_rad: Gain = Field(description="K_D")
    feedforward_inertia_kg_m2: float = Field(0.0, ge=0.0, le=1e4)
    stiffness_nm_per_rad: float = Field(gt=0.0, le=1e8, description="c0 = sigma0")
    damping_nms_per_rad: float = Field(ge=0.0, le=1e5, description="sigma1")
    viscous_nms_per_rad: float = Field(ge=0.0, le=1e4, description="F_v")
    coulomb_nm: Torque = Field(description="F_C")
    static_nm: Torque = Field(description="F_S")
    stribeck_velocity_rad_s: float = Field(gt=0.0, le=100.0, description="v_s")
    observer_gain: float = Field(0.0, ge=-10.0, le=10.0, description="l_f, in rad/s per unit of u* = u/K")
    input_scale_nm: Torque = Field(0.1, description="K")
    hold_within_rad: Width = 0.0
    friction_limit_nm: Torque = Field(description="bound of the compensated bristle force")

    @model_validator(mode="after")
    def _static_exceeds_coulomb(self) -> PdLugreParameters:
        if self.static_nm < self.coulomb_nm:
            raise ValueError("static_nm at least coulomb_nm")
        return self

    def pack(self) -> tuple[float, ...]:
        """Parameters in the order that the kernel reads."""
        return PdLugreGains(
            k_p=self.position_gain_nm_per_rad,
            k_d=self.velocity_gain_nms_per_rad,
            feedforward_inertia=self.feedforward_inertia_kg_m2,
            stiffness=self.stiffness_nm_per_rad,
            damping=self.damping_nms_per_rad,
            viscous=self.viscous_nms_per_rad,
            coulomb=self.coulomb_nm,
            static=self.static_nm,
            stribeck_velocity=self.stribeck_velocity_rad_s,
            observer_gain=self.observer_gain,
            input_scale=self.input_scale_nm,
            hold_within=self.hold_within_rad,
            state_limit=self.friction_limit_nm / self.stiffness_nm_per_rad,
        )


class RegionGains(Strict):
    """State feedback of one region (13): u* = k_x*e + k_v*e' - k_z*z_hat - sum k_u(i)*u*(k-i)."""

    k_z_per_rad: float = Field(0.0, ge=-1e7, le=1e7)
    k_x_per_rad: float = Field(ge=0.0, le=1e7)
    k_v_s_per_rad: float = Field(ge=0.0, le=1e6)
    k_u: list[Annotated[float, Field(ge=-10.0, le=10.0)]] | None = Field(
        None, max_length=local.COMMANDS, description="of the last commands u*, newest first"
    )

    @property
    def memory(self) -> tuple[float, float, float]:
        """Gains of the last three commands, newest first; 0.0 where none is given."""
        first, second, third, *_ = (*(self.k_u or []), 0.0, 0.0, 0.0)
        return first, second, third


class Regions(Strict):
    """The two regions of Fig. 5 and their overlap, in speed."""

    low: RegionGains
    high: RegionGains
    overlap_from_rad_s: float = Field(ge=0.0, le=1e3, description="up to this speed Omega_L holds alone")
    overlap_to_rad_s: float = Field(gt=0.0, le=1e3, description="from this speed Omega_H holds alone")

    @model_validator(mode="after")
    def _overlap_is_a_range(self) -> Regions:
        if self.overlap_from_rad_s >= self.overlap_to_rad_s:
            raise ValueError("overlap_from_rad_s less than overlap_to_rad_s")
        return self


class LocalSet(Strict):
    """One local set of (5) and (9)."""

    velocity_rad_s: float = Field(ge=-1e3, le=1e3, description="v_i")
    decay_per_s: float = Field(ge=0.0, le=1e7, description="a_i")
    gain: float = Field(0.0, ge=-10.0, le=10.0, description="l_i, in rad/s per unit of u*")


class OutputObserver(Strict):
    """Disturbance observer around the compensated axis."""

    bandwidth_rad_s: float = Field(gt=0.0, le=2000.0)
    low_bandwidth_rad_s: float | None = Field(
        None, gt=0.0, le=2000.0, description="in Omega_L; without: bandwidth_rad_s"
    )
    low_moving_bandwidth_rad_s: float | None = Field(
        None, gt=0.0, le=2000.0, description="in Omega_L under a moving reference; without: low_bandwidth_rad_s"
    )
    inertia_kg_m2: Inertia
    disturbance_limit_nm: Torque

    @property
    def moving_rad_s(self) -> float:
        """Bandwidth in Omega_L under a moving reference [rad/s]."""
        return self.low_moving_bandwidth_rad_s or self.low_bandwidth_rad_s or self.bandwidth_rad_s


class LocalFrictionSets(Strict):
    """The compensator of (9): one stiffness for all sets, a decay and a gain for each."""

    stiffness_nm_per_rad: float = Field(gt=0.0, le=1e8, description="c0_hat")
    viscous_nms_per_rad: float = Field(0.0, ge=0.0, le=1e4, description="d0_hat")
    friction_limit_nm: Torque = Field(description="bound of c0_hat*|z_hat|, F_max below (8)")
    leak_per_s: float = Field(2.0, ge=0.0, le=100.0, description="least decay, stops creep at rest")
    velocity: VelocitySource = Field(VelocitySource.MEASURED, strict=False)
    lead_s: float = Field(0.0, ge=0.0, le=0.02, description="lead of the reference velocity")
    weights: WeightShape = Field(WeightShape.LINEAR, strict=False)
    sets: list[LocalSet] = Field(min_length=3, max_length=MAX_SETS)

    @model_validator(mode="after")
    def _nodes_are_ordered(self) -> LocalFrictionSets:
        nodes = [s.velocity_rad_s for s in self.sets]
        if any(lower >= upper for lower, upper in itertools.pairwise(nodes)):
            raise ValueError("sets in ascending order of velocity_rad_s, none twice")
        if not (nodes[0] < 0.0 < nodes[-1] and 0.0 in nodes):
            raise ValueError("sets on both sides of velocity_rad_s 0 and one at 0")
        if self.lead_s and self.velocity is VelocitySource.MEASURED:
            raise ValueError("lead_s only with velocity: reference or corrected_reference")
        return self

    def named(self) -> Sets:
        """The sets as the kernel reads them."""
        return Sets(
            nodes=tuple(s.velocity_rad_s for s in self.sets),
            decays=tuple(s.decay_per_s for s in self.sets),
            gains=tuple(s.gain for s in self.sets),
        )


class PositionWave(Strict):
    """One wave of torque over position: amplitude*sin(n*x + phase)."""

    amplitude_nm: float = Field(ge=-1e5, le=1e5)
    waves_per_turn: float = Field(gt=0.0, le=1e8, description="n, waves in 2*pi rad")
    phase_rad: float = Field(0.0, ge=-100.0, le=100.0)


class PositionFeedforward(Strict):
    """Known torques over position that the joint resists with; see servod.kernels.laws.position."""

    lead_s: float = Field(0.0, ge=0.0, le=2.0, description="lead of the reference position")
    offset_nm: float = Field(0.0, ge=-1e5, le=1e5)
    spring_nm_per_rad: float = Field(0.0, ge=0.0, le=1e7)
    spring_rest_rad: float = Field(0.0, ge=-1e5, le=1e5)
    spring_cubic_nm_per_rad3: float = Field(0.0, ge=0.0, le=1e7)
    waves: list[PositionWave] = Field(
        default_factory=list, max_length=MAX_WAVES, description="cogging by its harmonics; gravity is one wave a turn"
    )

    def named(self) -> PositionTorques:
        """The same as the kernel reads it."""
        return PositionTorques(
            lead=self.lead_s,
            offset=self.offset_nm,
            spring=self.spring_nm_per_rad,
            spring_rest=self.spring_rest_rad,
            spring_cubic=self.spring_cubic_nm_per_rad3,
            waves=tuple(value for w in self.waves for value in (w.amplitude_nm, w.waves_per_turn, w.phase_rad)),
        )


class LocalParameters(Strict):
    """The local-model gain-scheduled law (9), (16)."""

    law: Literal["local"]
    input_scale_nm: Torque = Field(0.1, description="K, u* = u/K")
    regions: Regions
    friction: LocalFrictionSets
    disturbance_observer: OutputObserver | None = None
    feedforward_inertia_kg_m2: float = Field(0.0, ge=0.0, le=1e4)
    hold_within_rad: Width = 0.0
    error_limit_rad: float | None = Field(
        None, gt=0.0, le=1e3, description="the feedback sees no more error, which bounds the speed of a step"
    )
    rest_within_rad: Width | None = Field(
        None, description="with less error than this, a joint that shall stand is at rest; without: never"
    )
    rest_share: float | None = Field(
        None, gt=0.0, le=1.0, description="of feedback and observer that is left at rest; without: all"
    )
    position_feedforward: PositionFeedforward | None = None

    def pack(self) -> tuple[float, ...]:
        """Parameters in the order that the kernel reads: head, then all v_i, all a_i, all l_i, then position."""
        return self.named().flat()

    def named(self) -> local.LocalGains:
        """Parameters by the names that the kernel reads."""
        f, observer = self.friction, self.disturbance_observer
        low, high = self.regions.low, self.regions.high
        position = self.position_feedforward
        return local.LocalGains(
            input_scale=self.input_scale_nm,
            low_k_z=low.k_z_per_rad,
            low_k_x=low.k_x_per_rad,
            low_k_v=low.k_v_s_per_rad,
            high_k_z=high.k_z_per_rad,
            high_k_x=high.k_x_per_rad,
            high_k_v=high.k_v_s_per_rad,
            blend_from=self.regions.overlap_from_rad_s,
            blend_to=self.regions.overlap_to_rad_s,
            stiffness=f.stiffness_nm_per_rad,
            viscous=f.viscous_nms_per_rad,
            leak=f.leak_per_s,
            state_limit=f.friction_limit_nm / f.stiffness_nm_per_rad,
            source=_SOURCES[f.velocity],
            lead=f.lead_s,
            shape=float(Shape[f.weights.name]),
            hold_within=self.hold_within_rad,
            feedforward_inertia=self.feedforward_inertia_kg_m2,
            observer_bandwidth=observer.bandwidth_rad_s if observer else 0.0,
            observer_inertia=observer.inertia_kg_m2 if observer else 0.0,
            observer_limit=observer.disturbance_limit_nm if observer else 0.0,
            low_k_u1=low.memory[0],
            low_k_u2=low.memory[1],
            low_k_u3=low.memory[2],
            high_k_u1=high.memory[0],
            high_k_u2=high.memory[1],
            high_k_u3=high.memory[2],
            observer_low=(observer.low_bandwidth_rad_s or observer.bandwidth_rad_s) if observer else 0.0,
            error_limit=self.error_limit_rad or 0.0,
            rest_within=self.rest_within_rad or 0.0,
            rest_share=self.rest_share or 1.0,
            observer_moving=observer.moving_rad_s if observer else 0.0,
            sets=f.named(),
            knows_position=position is not None,
            position=position.named() if position else PositionTorques(),
        )


Parameters = Annotated[PdParameters | PdDobParameters | PdLugreParameters | LocalParameters, Field(discriminator="law")]
