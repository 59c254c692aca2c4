"""A virtual axis to deploy on, SYNC-stepped, with the encoder and the velocity filter that the set was designed for.

Beside `links`; behind `servoctl deploy --plant`, the commissioning walk and tests.
"""

from __future__ import annotations

import datetime
from pathlib import Path

from servod.client.links import SteppedDeployLink
from servod.client.virtual import ENCODER_COUNTS, rated_torque_mnm, virtual_config, virtual_session
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, Provenance
from servod.formats.gains.parameters import PdParameters
from servod.formats.gains.store import GainStore
from servod.formats.model.axis_model import AxisModel


def virtual_link(
    plant: AxisModel,
    folder: Path,
    wanted: GainSet,
    present: GainSet | None = None,
    seed: int = 1,
    config: AxisConfig | None = None,
    settings: VirtualAxisSettings | None = None,
) -> SteppedDeployLink:
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
    return SteppedDeployLink(session, GainStore(folder / "gains"), present or powerless())


def with_cutoff(config: AxisConfig, cutoff_hz: float) -> AxisConfig:
    """The configuration with another velocity filter."""
    encoder = config.encoder.model_copy(update={"velocity_cutoff_hz": cutoff_hz})
    return config.model_copy(update={"encoder": encoder})


def powerless() -> GainSet:
    """A PD controller with zero gains: what an axis without any tuning runs."""
    return pd_set("powerless", 0.0, 0.0)


def pd_set(name: str, position_nm_per_rad: float, velocity_nms_per_rad: float) -> GainSet:
    """A PD gain set made by the tool."""
    parameters = PdParameters(
        law="pd",
        position_gain_nm_per_rad=position_nm_per_rad,
        velocity_gain_nms_per_rad=velocity_nms_per_rad,
        feedforward_inertia_kg_m2=0.0,
    )
    today = datetime.datetime.now(tz=datetime.UTC).date()
    source = Provenance(author="servod", date=today, tool="servoctl deploy")
    return GainSet(schema_version=1, name=name, parameters=parameters, provenance=source)
