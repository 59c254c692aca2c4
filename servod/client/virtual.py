"""A virtual axis that suits its joint, SYNC-stepped: drive and limits of the size that somebody would have bought.

Behind `--plant`. Only the size of the drive is taken from the plant; everything else has to be identified.
"""

from __future__ import annotations

import math
from pathlib import Path

from servod.client.stepped import SteppedAxis, SteppedSession
from servod.common.yaml import validate
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, CoulombViscousFriction
from servod.kernels.laws import LAWS
from servod.kernels.physics.plant import Plant

#: Rated torque of the drive over the joint's static friction, and peak over rated, as of the demo's axis.
RATED_RATIO, PEAK_RATIO = 1.43, 3.0
#: The torque limit is reached from zero in a millisecond.
RATE_PER_S = 1000.0
#: A configured rated torque within this factor of what suits is taken for the drive's; any other is a wrong scale.
ALIKE = 5.0
ENCODER_COUNTS = 1_048_576
#: A joint rests that moves by less within this time; it was held where it is still that near to where it began.
REST_S, REST_TRIES, RESTS_RAD, HOLDS_RAD = 0.5, 60, 1e-6, 0.01
SPEED_RAD_S, TRAVEL_RAD, FOLLOWING_RAD, MISMATCH_RAD = 3.0, 3.0, 0.5, 0.05


def rated_torque_mnm(plant: AxisModel) -> int:
    """Rated torque of a drive for this joint, in mN*m, to two digits."""
    friction = plant.friction
    sticks = getattr(friction, "static", None) or getattr(friction, "coulomb", None)
    static = sticks if sticks is not None else max(abs(t) for t in getattr(friction, "torques", (0.07,)))
    held = abs(plant.gravity.amplitude) if plant.gravity else 0.0
    wanted = 1000.0 * RATED_RATIO * (float(static) + held)
    return max(1, int(float(f"{wanted:.1e}")))


def virtual_config(folder: Path, rated_mnm: int, encoder_counts: int) -> AxisConfig:
    """Configuration of the master's side; `folder` is for sockets and stores, which a stepped axis never opens."""
    peak_nm = PEAK_RATIO * rated_mnm * 1e-3
    return validate(
        {
            "name": "virtual",
            "bus": {"interface": "virtual", "channel": str(folder / "bus")},
            "encoder": {"counts_per_turn": encoder_counts},
            "limits": {
                "torque_nm": peak_nm,
                "torque_rate_nm_per_s": RATE_PER_S * peak_nm,
                "speed_rad_s": SPEED_RAD_S,
                "position_min_rad": -TRAVEL_RAD,
                "position_max_rad": TRAVEL_RAD,
                "following_error_rad": FOLLOWING_RAD,
                "encoder_mismatch_rad": MISMATCH_RAD,
            },
            "gains": {"directory": str(folder), "initial": str(folder / "pd.yaml"), "accept_uncertified": True},
            "recorder": {"directory": str(folder)},
        },
        AxisConfig,
        "virtual axis",
    )


def virtual_session(
    plant: AxisModel,
    folder: Path,
    encoder_counts: int | None,
    seed: int,
    config: AxisConfig | None = None,
    settings: VirtualAxisSettings | None = None,
) -> SteppedSession:
    """A session on the virtual axis, disabled, zero gains; a `config` of the user's replaces the one that suits.

    `settings` say what drive and encoder really are, right or wrong, as for servod-virtual-axis; without them they are
    what suits the joint, with `encoder_counts` per turn (None: what the configuration says). Raises BadInput where the
    configuration does not fit the devices.
    """
    rated = rated_torque_mnm(plant)
    config = config or virtual_config(folder, rated, encoder_counts or ENCODER_COUNTS)
    settings = settings or _devices(config, rated, encoder_counts, seed, resting_rad(plant))
    law = LAWS["pd"]
    return SteppedSession(config, SteppedWorld(settings, plant), law.number, (0.0,) * law.n_parameters)


def resting_rad(plant: AxisModel) -> float:
    """Where the joint rests without torque, rad: at zero where friction holds it, else at its lowest point.

    A weight or a spring above friction has pulled the joint away when somebody comes to switch the axis on. Where it
    fell to it would be held by friction's last bit, and slide on at the first touch; whoever touches it leaves it where
    nothing pulls.
    """
    weight, spring = plant.gravity, plant.spring
    stiffness = (abs(weight.amplitude) if weight else 0.0) + (spring.stiffness if spring else 0.0)
    still = plant.model_copy(update={"noise": None, "disturbance": None})
    if stiffness == 0.0 or abs(_fallen_rad(still)) < HOLDS_RAD:
        return 0.0
    critical = 2.0 * math.sqrt(stiffness * plant.inertia)
    damped = CoulombViscousFriction(kind="coulomb_viscous", viscous=critical)
    offset = plant.torque_offset
    return _fallen_rad(
        AxisModel(inertia=plant.inertia, friction=damped, gravity=weight, spring=spring, torque_offset=offset)
    )


def _fallen_rad(plant: AxisModel) -> float:
    """Where the joint comes to rest that begins at zero, rad."""
    joint = Plant(plant)
    for _ in range(REST_TRIES):
        before = joint.position_rad
        joint.advance(0.0, REST_S)
        if abs(joint.position_rad - before) < RESTS_RAD:
            break
    return joint.position_rad


def _devices(
    config: AxisConfig, rated_mnm: int, encoder_counts: int | None, seed: int, start_rad: float
) -> VirtualAxisSettings:
    """Node ids, bus and encoder of the configuration, and a drive that suits the joint."""
    wanted = config.amplifier.rated_torque_mnm
    if wanted is not None and rated_mnm / ALIKE <= wanted <= rated_mnm * ALIKE:
        rated_mnm = wanted
    return VirtualAxisSettings(
        amplifier_node_id=config.amplifier.node_id,
        encoder_node_id=config.encoder.node_id,
        rated_torque_mnm=rated_mnm,
        encoder_counts_per_turn=encoder_counts or config.encoder.counts_per_turn,
        cycle_period_s=config.cycle.period_us * 1e-6,
        bit_rate=config.bus.bit_rate,
        seed=seed,
        start_position_rad=start_rad,
    )


def axis_for_set(
    plant: AxisModel,
    folder: Path,
    wanted: GainSet,
    present: GainSet | None = None,
    seed: int = 1,
    config: AxisConfig | None = None,
    settings: VirtualAxisSettings | None = None,
) -> SteppedAxis:
    """A disabled axis whose store in `folder` holds `present` (a controller without torque unless given).

    A `config` of the user's stays as it is; without one the axis gets the encoder and filter of `wanted`. `settings`
    say what drive and encoder really are.
    """
    design = wanted.design
    if config is None:
        counts = round(design.counts_per_turn) if design and design.counts_per_turn else ENCODER_COUNTS
        config = virtual_config(folder, rated_torque_mnm(plant), counts)
        config = with_cutoff(config, design.velocity_cutoff_hz) if design else config
    session = virtual_session(plant, folder, config.encoder.counts_per_turn, seed, config, settings)
    axis = SteppedAxis(session, folder, present)
    axis.run_active()
    return axis


def with_cutoff(config: AxisConfig, cutoff_hz: float) -> AxisConfig:
    """The configuration with another velocity filter."""
    encoder = config.encoder.model_copy(update={"velocity_cutoff_hz": cutoff_hz})
    return config.model_copy(update={"encoder": encoder})
