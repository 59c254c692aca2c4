"""All that an axis of the trial can do, as plain numbers; zero (or one for factors) is absent.

Stands under the trial's plant. Deliberately not the axis model of `servod.formats.model.axis_model`: other quantities,
other forms, so that the trial does not ask the diagnosis for its own equations.
"""

from __future__ import annotations

from typing import NamedTuple


class Physics(NamedTuple):
    """Numbers of one axis in rad, N*m, s, degC. `*_shape` chooses a waveform (`plant.wave`) or a law, as said there.

    `elastic_share`: share of the bristle's range without creep (elasto-plastic; Dupont et al., IEEE TAC 47, 2002; 0 is
    LuGre's). `front_*` and `back_*` are factors of friction for v > 0 and v < 0.
    """

    inertia: float = 1.0
    coulomb: float = 1.0
    static: float = 1.0
    viscous: float = 0.0
    stribeck_velocity: float = 0.1
    stribeck_exponent: float = 2.0
    sigma0: float = 1000.0
    sigma1: float = 1.0
    elastic_share: float = 0.0
    front_dry: float = 1.0
    back_dry: float = 1.0
    front_viscous: float = 1.0
    back_viscous: float = 1.0
    drag_torque: float = 0.0  # N*m at drag_speed
    drag_speed: float = 1.0
    drag_exponent: float = 2.0
    dry_per_torque: float = 0.0
    dry_per_load: float = 0.0
    grip_share: float = 0.0  # position-dependent dry friction
    grip_order: float = 1.0
    grip_phase: float = 0.0
    grip_shape: float = 0.0
    spot_share: float = 0.0  # tight spot
    spot_place: float = 0.0
    spot_width: float = 1.0
    cogging: float = 0.0
    cogging_order: float = 1.0
    cogging_phase: float = 0.0
    cogging_second: float = 0.0  # amplitude of the second harmonic
    cogging_shape: float = 0.0
    ripple_share: float = 0.0
    ripple_order: float = 1.0
    ripple_phase: float = 0.0
    ripple_shape: float = 0.0
    gravity: float = 0.0
    gravity_phase: float = 0.0
    gravity_second: float = 0.0  # a linkage's: amplitude of sin(2x)
    spring: float = 0.0
    spring_rest: float = 0.0
    spring_cubic: float = 0.0
    spring_slack: float = 0.0  # way to both sides without torque
    load_inertia: float = 0.0  # behind the joint's spring; beside `inertia`
    joint_stiffness: float = 0.0
    joint_cubic: float = 0.0
    joint_damping: float = 0.0
    joint_gap: float = 0.0
    load_viscous: float = 0.0
    gain_front: float = 1.0
    gain_back: float = 1.0
    limit: float = 0.0
    limit_shape: float = 0.0  # 0 clip, 1 tanh
    delay_s: float = 0.001
    lag_s: float = 0.0
    lag_order: float = 1.0
    slew: float = 0.0
    warm_dry: float = 0.0  # share lost per degC
    warm_viscous: float = 0.0
    warm_shape: float = 0.0  # 0 straight, 1 exponential
    heating: float = 0.0  # degC per J
    cooling_s: float = 60.0
    swing_share: float = 0.0  # position-dependent inertia
    swing_order: float = 1.0
    swing_phase: float = 0.0
    swing_second: float = 0.0
    eccentricity: float = 0.0
    eccentricity_order: float = 1.0
    eccentricity_phase: float = 0.0
    eccentricity_second: float = 0.0
    offset: float = 0.0
    push: float = 0.0
    push_start_s: float = 0.0
    push_end_s: float = 0.0
    push_shape: float = 0.0  # 0 constant, 1 half sine, 2 rising
    peak_torque: float = 0.0  # unknown: a resonance of the bearing cage, friction in a band of speeds
    peak_speed: float = 1.0
    peak_width: float = 1.0
    ageing: float = 0.0  # unknown: contacts that age at rest, share of Coulomb friction
    ageing_s: float = 1.0
    relaxing: float = 0.0  # unknown: a spring whose rest position follows, N*m/rad
    relaxing_s: float = 1.0
    chaos: float = 0.0  # unknown: a chaotic load, N*m
    chaos_rate: float = 1.0
    way_share: float = 0.0  # unknown: dry friction periodic in the way travelled, not in position
    way_length: float = 1.0
    patchy_share: float = 0.0  # unknown: dry friction that jumps at random times
    patchy_s: float = 1.0
