"""From an axis model to a gain set: local sets, both regions, options of the law, provenance and design.

Top of servod.lab.synthesize. What the law gets is chosen here from what its loop allows, by the same sweep that
verification uses.
"""

from __future__ import annotations

import datetime
import hashlib
from dataclasses import dataclass
from pathlib import Path

import servod
from servod.common.sources import SYNTHESIZES, source_sha256
from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import (
    LocalFrictionSets,
    LocalParameters,
    OutputObserver,
    RegionGains,
    Regions,
    VelocitySource,
    WeightShape,
)
from servod.formats.model.axis_model import AxisModel
from servod.lab.synthesize.deployed import Wishes, designs, region_gains
from servod.lab.synthesize.infeasible import Infeasible, explain
from servod.lab.synthesize.local_sets import (
    ACCURACY,
    LIMIT_SHARE,
    PAPER_NODES,
    STIFFNESS_SHARE,
    compensator,
    input_scale,
    local_sets,
    position_feedforward,
    sets_at,
)
from servod.lab.synthesize.observer_width import (
    ENOUGH_RAD_S,
    OBSERVERS_RAD_S,
    SHARES,
    bandwidth_of,
    designed,
    with_moving_observer,
    with_observer,
    with_returning_velocity,
    with_share_at_rest,
    with_widest_observer,
)
from servod.lab.verify.rounding import hold_width, rest_width
from servod.lab.verify.steady_friction import SteadyFriction, steady_friction

# --- Where a set comes from ------------------------------------------------------------------------------------------
# Where a synthesized set comes from: hashes of the model's file, of the recordings behind it, and of this tool. The
# recordings' hashes stand in the model that an identification wrote; the tool's hash is over the sources that compute,
# so that two versions of one number are told apart.


def provenance(model: AxisModel, model_path: Path | None, note: str) -> Provenance:
    """The provenance of a set for `model`, which was read from `model_path`. Raises OSError when it cannot be read."""
    return Provenance(
        author="servod",
        date=datetime.datetime.now(datetime.UTC).date(),
        tool=f"servod {servod.__version__} synthesize",
        tool_sha256=source_sha256(SYNTHESIZES),
        model_sha256=hashlib.sha256(model_path.read_bytes()).hexdigest() if model_path else None,
        data_sha256=list(model.identified.data_sha256) if model.identified else [],
        note=note,
    )


OBSERVER_SHARE = 2.5  # bound of the estimate: friction that turned against a z_hat that a step leaves as it was
APPROACH = 3.0  # speed with which a step is approached, as a factor on the map's highest


@dataclass(frozen=True, slots=True)
class DesignOptions:
    """Named options of the law and of its local sets."""

    name: str = "synthesized"
    accuracy: float = ACCURACY
    paper_nodes: bool = False
    velocity: VelocitySource = VelocitySource.CORRECTED_REFERENCE
    observer: bool = True
    gain: float | None = None  # l_i; None = 0 where the observer is the integral action, else designed
    leak_per_s: float = 2.0
    weights: WeightShape = WeightShape.LINEAR
    position_feedforward: bool = True


def feedback_of(design: Design, scale: float) -> Regions:
    """Feedback of both regions as proven."""
    low, high = design.regions
    return Regions(
        low=region_gains(low, scale),
        high=region_gains(high, scale),
        overlap_from_rad_s=high.speed_from_rad_s,
        overlap_to_rad_s=low.speed_to_rad_s,
    )


def parameters(
    design: Design, friction: SteadyFriction, options: DesignOptions, bandwidth: float, feedback: Regions | None = None
) -> LocalParameters:
    """The law's parameters with an output observer of `bandwidth` rad/s (0: none); `feedback`: None = as proven."""
    speed, largest = design.speed_max_rad_s, friction.largest(design.speed_max_rad_s)
    scale = input_scale(friction, speed)
    used = feedback or feedback_of(design, scale)
    return LocalParameters(
        law="local",
        input_scale_nm=scale,
        regions=used,
        friction=compensation(design, friction, options),
        disturbance_observer=OutputObserver(
            bandwidth_rad_s=bandwidth,
            inertia_kg_m2=friction.inertia,
            disturbance_limit_nm=OBSERVER_SHARE * largest,
        )
        if bandwidth
        else None,
        feedforward_inertia_kg_m2=friction.inertia,
        hold_within_rad=hold_width(design),
        rest_within_rad=rest_width(design),
        rest_share=SHARES[0],
        error_limit_rad=approach_error(used.high, APPROACH * speed),
        position_feedforward=position_feedforward(design.model, friction.gain, design.period_s)
        if options.position_feedforward
        else None,
    )


def compensation(design: Design, friction: SteadyFriction, options: DesignOptions) -> LocalFrictionSets:
    """The local sets with what all of them share."""
    speed = design.speed_max_rad_s
    c = compensator(friction, speed, STIFFNESS_SHARE * (1.0 - design.uncertainty.stiffness))
    sets = (
        sets_at(friction, c, PAPER_NODES, options.gain or 0.0)
        if options.paper_nodes
        else local_sets(friction, c, speed, options.accuracy, options.gain or 0.0)
    )
    return LocalFrictionSets(
        stiffness_nm_per_rad=c.stiffness,
        viscous_nms_per_rad=c.viscous,
        friction_limit_nm=LIMIT_SHARE * friction.largest(speed),
        leak_per_s=options.leak_per_s,
        velocity=options.velocity,
        weights=options.weights,
        sets=sets,
    )


def approach_error(high: RegionGains, speed: float) -> float | None:
    """Error at which the feedback of Omega_H asks for `speed` [rad/s]; None without position feedback."""
    return speed * high.k_v_s_per_rad / high.k_x_per_rad if high.k_x_per_rad > 0.0 else None


def synthesize(
    model: AxisModel, wishes: Wishes | None = None, options: DesignOptions | None = None, model_path: Path | None = None
) -> GainSet | Infeasible:
    """The gain set for `model`, sealed and not yet certified; or why there is none and what would help."""
    wishes, options = wishes or Wishes(), options or DesignOptions()
    friction = steady_friction(model)
    best: tuple[float, Design, LocalParameters] | None = None
    for design in designs(model, wishes):
        law = parameters(design, friction, options, OBSERVERS_RAD_S[0] if options.observer else 0.0)
        if law.disturbance_observer is not None:
            law = with_widest_observer(design, friction, law, best[0] if best else 0.0)
        bandwidth = bandwidth_of(law)
        if best is None or bandwidth > best[0]:
            best = bandwidth, design, law
        if bandwidth >= ENOUGH_RAD_S or not options.observer:
            break
    if best is None:
        return explain(model, wishes)
    _, design, law = best
    if law.disturbance_observer is None and options.gain is None:
        law = designed(design, friction, law)
    found = with_share_at_rest(gain_set(design, law, options, model_path))
    return with_moving_observer(found, friction) if law.disturbance_observer else with_returning_velocity(found)


def gain_set(design: Design, law: LocalParameters, options: DesignOptions, model_path: Path | None) -> GainSet:
    """The sealed set with its provenance."""
    observer = law.disturbance_observer
    note = (
        f"Velocity filter: set encoder.velocity_cutoff_hz to {design.velocity_cutoff_hz:g}. c0_hat is "
        f"{STIFFNESS_SHARE:g} of the lowest c0 in its interval; 1.0 is marginal. "
        + (f"Output observer {observer.bandwidth_rad_s:g} rad/s." if observer else "No output observer stands.")
    )
    return GainSet(
        schema_version=1,
        name=options.name,
        description=f"Local law for inertia {design.model.inertia:g}, {design.mode.value} mode.",
        parameters=law,
        provenance=provenance(design.model, model_path, note),
        design=design,
    ).sealed()


def with_feedback(
    gains: GainSet,
    name: str,
    position_nm_per_rad: float,
    velocity_nms_per_rad: float,
    observer_rad_s: float | None = None,
) -> GainSet:
    """The same compensation with a given PD feedback in both regions: for comparisons at equal feedback.

    `observer_rad_s` replaces the observer's bandwidth where the set has an observer. The result has no design, for
    nothing proves it, and so it cannot be certified.
    """
    law = gains.parameters
    assert isinstance(law, LocalParameters)
    same = RegionGains(
        k_x_per_rad=position_nm_per_rad / law.input_scale_nm, k_v_s_per_rad=velocity_nms_per_rad / law.input_scale_nm
    )
    regions_with = law.regions.model_copy(update={"low": same, "high": same})
    if law.disturbance_observer is not None and observer_rad_s is not None:
        law = with_observer(law, observer_rad_s, None)
    changed = law.model_copy(update={"regions": regions_with, "error_limit_rad": None})
    return gains.model_copy(
        update={"name": name, "parameters": changed, "design": None, "certificate": None, "seal": None}
    )
