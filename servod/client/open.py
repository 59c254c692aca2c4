"""How an axis is opened: for `servoctl demo --diagnose`, and for each step of a commissioning.

Above both ways to an axis, which they give as servod.client.axis.AxisClient.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from servod.client.axis import AxisClient
from servod.client.control import ControlClient
from servod.client.processes import last_core, own_group, running_axis
from servod.client.stepped import SteppedAxis
from servod.client.under_daemon import DaemonAxis, require_daemon_config
from servod.client.virtual import (
    ENCODER_COUNTS,
    axis_for_set,
    rated_torque_mnm,
    virtual_config,
    virtual_session,
    with_cutoff,
)
from servod.common.errors import Unreachable
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.formats.protocol import Verb

#: After an axis was enabled, until what is held has come to rest.
_SETTLE_S = 1.0


def config_for(plant: AxisModel, gains: GainSet, folder: Path) -> AxisConfig:
    """Configuration of a virtual axis with this joint, and the velocity filter that the set was designed for."""
    assert gains.design is not None  # it was synthesized
    config = virtual_config(folder, rated_torque_mnm(plant), ENCODER_COUNTS)
    return with_cutoff(config, gains.design.velocity_cutoff_hz)


@contextlib.contextmanager
def stepped_axis(plant: AxisModel, gains: GainSet, folder: Path, seed: int) -> Iterator[AxisClient]:
    """A stepped axis, enabled under `gains`; its store is in `folder`."""
    axis = axis_for_set(plant, folder, gains, gains, seed, config_for(plant, gains, folder))
    axis.enable()
    axis.wait(_SETTLE_S)
    yield axis


@contextlib.contextmanager
def daemon_axis(plant: AxisModel, gains: GainSet, folder: Path, _seed: int) -> Iterator[AxisClient]:
    """Daemon and virtual axis as processes, enabled under `gains`. Raises Unreachable when one does not start."""
    config = config_for(plant, gains, folder)
    joint, initial = folder / "plant.yaml", folder / "initial.yaml"
    joint.write_text(axis_model_yaml(plant), encoding="utf-8")
    initial.write_text(gains.to_yaml(), encoding="utf-8")
    cycle = config.cycle.model_copy(update={"cpu": last_core(), "priority": 80})
    limits = config.limits.model_copy(update={"stale_cycles": 50, "late_cycles": 500})
    kept = config.gains.model_copy(update={"directory": folder / "gains", "initial": initial})
    control = config.control.model_copy(update={"socket": folder / "axis.sock", "group": own_group()})
    changed = {"cycle": cycle, "limits": limits, "gains": kept, "control": control}
    drive = ("--rated-torque-mnm", str(rated_torque_mnm(plant)))
    with running_axis(config.model_copy(update=changed), joint, folder, drive) as (client, _):
        axis = DaemonAxis(client)
        axis.enable()
        axis.wait(_SETTLE_S)
        yield axis
        axis.disable()


# --- The axis of a commissioning -------------------------------------------------------------------------------------
# The axis of a commissioning: how its experiments, deployments and comparisons open it, and what tells it from others.
# The virtual axis is SYNC-stepped and gets the velocity filter that a set was designed for; the axis under a daemon
# keeps what its configuration says.


#: A step of the reference is as fast as the torque lets it be: so many times the speed of the experiments' limit.
STEP_SPEEDS = 10.0


class WalkAxis(Protocol):
    """An axis under commissioning."""

    @property
    def config(self) -> AxisConfig:
        """Limits, cycle and encoder; the velocity filter is the one before any design."""
        ...

    @property
    def identity(self) -> dict[str, Any]:
        """What tells this axis from another one, in plain values."""
        ...

    def nodes(self) -> list[dict[str, Any]]:
        """Its nodes, as the daemon's status tells of them; none where no daemon is reached."""
        ...

    @property
    def cutoff_hz(self) -> float | None:
        """The velocity filter that a design must take; None where it may choose."""
        ...

    @property
    def virtual(self) -> bool:
        """Whether nobody can be hurt."""
        ...

    def experiments(self) -> contextlib.AbstractContextManager[AxisClient]:
        """The axis for an identification."""
        ...

    def deployment(
        self, folder: Path, gains: GainSet, present: GainSet
    ) -> contextlib.AbstractContextManager[AxisClient]:
        """The axis for a deployment; a virtual one runs `present` before, and keeps its sets in `folder`."""
        ...


@dataclass(frozen=True)
class VirtualWalkAxis:
    """A virtual axis; `chosen` and `settings` replace the configuration and the devices that suit the joint."""

    joint: AxisModel
    seed: int
    encoder_counts: int | None = None
    chosen: AxisConfig | None = None
    settings: VirtualAxisSettings | None = None
    virtual: bool = True

    @cached_property
    def config(self) -> AxisConfig:
        """The user's configuration, or the one that suits the joint."""
        counts = self.encoder_counts or 1_048_576
        return self.chosen or virtual_config(Path(tempfile.gettempdir()), rated_torque_mnm(self.joint), counts)

    @property
    def identity(self) -> dict[str, Any]:
        """Joint, devices and configuration."""
        plant = hashlib.sha256(axis_model_yaml(self.joint).encode()).hexdigest()
        devices = self.settings.model_dump(mode="json") if self.settings else None
        return {"plant": plant, "devices": devices} | identifying_keys(self.config)

    def nodes(self) -> list[dict[str, Any]]:
        """None: its devices are those of the configuration."""
        return []

    @property
    def cutoff_hz(self) -> float | None:
        """Free: the virtual axis is configured as the design wants it."""
        return None

    @contextlib.contextmanager
    def experiments(self) -> Iterator[AxisClient]:
        """A new session."""
        with tempfile.TemporaryDirectory(prefix="servod-commission-") as folder:
            session = virtual_session(
                self.joint, Path(folder), self.encoder_counts, self.seed, self.config, self.settings
            )
            yield SteppedAxis(session, Path(folder))

    @contextlib.contextmanager
    def deployment(self, folder: Path, gains: GainSet, present: GainSet) -> Iterator[AxisClient]:
        """A new session with the filter of `gains`, and an empty store in `folder`."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        yield axis_for_set(self.joint, folder, gains, present, self.seed, self.with_filter_for(gains), self.settings)

    def with_filter_for(self, gains: GainSet) -> AxisConfig:
        """The configuration with the velocity filter that the set was designed for."""
        return with_cutoff(self.config, gains.design.velocity_cutoff_hz) if gains.design else self.config

    def for_tracking(self, folder: Path, cutoff_hz: float, seed: int) -> SteppedAxis:
        """A disabled axis with this velocity filter for a comparison of laws; `seed` begins its noise."""
        config = with_cutoff(self.config, cutoff_hz)
        if self.chosen is None:
            limits = config.limits.model_copy(update={"speed_rad_s": STEP_SPEEDS * config.limits.speed_rad_s})
            config = config.model_copy(update={"limits": limits})
        session = virtual_session(self.joint, folder, self.encoder_counts, seed, config, self.settings)
        return SteppedAxis(session, folder)


@dataclass(frozen=True)
class DaemonWalkAxis:
    """The axis under the daemon at `socket`; `config` must be the file that the daemon was started with."""

    socket: Path
    config: AxisConfig
    virtual: bool = False

    @property
    def identity(self) -> dict[str, Any]:
        """The configuration."""
        return {"name": self.config.name} | identifying_keys(self.config)

    def nodes(self) -> list[dict[str, Any]]:
        """As the daemon tells of them; none when it has ended, for a page can be made without it."""
        try:
            with ControlClient(self.socket) as client:
                found: list[dict[str, Any]] = client.call(Verb.STATUS)["nodes"]
        except Unreachable:
            return []
        return found

    @property
    def cutoff_hz(self) -> float | None:
        """As configured."""
        return self.config.encoder.velocity_cutoff_hz

    @contextlib.contextmanager
    def experiments(self) -> Iterator[AxisClient]:
        """Over the daemon's control socket."""
        with ControlClient(self.socket) as client:
            yield DaemonAxis(client, self.config)

    @contextlib.contextmanager
    def deployment(self, folder: Path, gains: GainSet, present: GainSet) -> Iterator[AxisClient]:
        """Over the daemon's control socket; the sets are in its own store. Raises BadInput on another configuration."""
        with ControlClient(self.socket) as client:
            require_daemon_config(client, self.config)
            yield DaemonAxis(client)


def identifying_keys(config: AxisConfig) -> dict[str, Any]:
    """What of a configuration makes another axis of it: cycle, devices and limits, without the velocity filter."""
    parts = config.model_dump(mode="json", include={"cycle", "amplifier", "encoder", "limits"})
    parts["encoder"].pop("velocity_cutoff_hz")
    return parts
