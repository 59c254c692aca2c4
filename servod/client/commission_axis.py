"""The axis that a walk is on: how experiments, deployments and comparisons reach it, and what tells it from others.

Under the steps. The virtual axis is SYNC-stepped and gets the velocity filter that a set was designed for; the axis
under a daemon keeps what its configuration says.
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

from servod.client.axis import Link, SteppedLink
from servod.client.control import ControlClient
from servod.client.daemon_config import require_daemon_config
from servod.client.daemon_link import DaemonLink
from servod.client.deploy_daemon import DaemonDeployLink
from servod.client.deploy_virtual import virtual_link, with_cutoff
from servod.client.links import DeployLink
from servod.client.stepped import SteppedSession
from servod.client.virtual import rated_torque_mnm, virtual_config, virtual_session
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, axis_model_yaml

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

    @property
    def cutoff_hz(self) -> float | None:
        """The velocity filter that a design must take; None where it may choose."""
        ...

    @property
    def virtual(self) -> bool:
        """Whether nobody can be hurt."""
        ...

    def experiments(self) -> contextlib.AbstractContextManager[Link]:
        """The axis for an identification."""
        ...

    def deployment(
        self, folder: Path, gains: GainSet, present: GainSet
    ) -> contextlib.AbstractContextManager[DeployLink]:
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
        return {"plant": plant, "devices": devices} | configured(self.config)

    @property
    def cutoff_hz(self) -> float | None:
        """Free: the virtual axis is configured as the design wants it."""
        return None

    @contextlib.contextmanager
    def experiments(self) -> Iterator[Link]:
        """A new session."""
        with tempfile.TemporaryDirectory(prefix="servod-commission-") as folder:
            yield SteppedLink(self._session(Path(folder), self.config))

    @contextlib.contextmanager
    def deployment(self, folder: Path, gains: GainSet, present: GainSet) -> Iterator[DeployLink]:
        """A new session with the filter of `gains`, and an empty store in `folder`."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        yield virtual_link(self.joint, folder, gains, present, self.seed, self.configured_for(gains), self.settings)

    def configured_for(self, gains: GainSet) -> AxisConfig:
        """The configuration with the velocity filter that the set was designed for."""
        return with_cutoff(self.config, gains.design.velocity_cutoff_hz) if gains.design else self.config

    def open_session(self, folder: Path, cutoff_hz: float, seed: int) -> SteppedSession:
        """A disabled session with this velocity filter for a comparison of laws; `seed` begins its noise."""
        config = with_cutoff(self.config, cutoff_hz)
        if self.chosen is None:
            limits = config.limits.model_copy(update={"speed_rad_s": STEP_SPEEDS * config.limits.speed_rad_s})
            config = config.model_copy(update={"limits": limits})
        return virtual_session(self.joint, folder, self.encoder_counts, seed, config, self.settings)

    def _session(self, folder: Path, config: AxisConfig) -> SteppedSession:
        return virtual_session(self.joint, folder, self.encoder_counts, self.seed, config, self.settings)


@dataclass(frozen=True)
class DaemonWalkAxis:
    """The axis under the daemon at `socket`; `config` must be the file that the daemon was started with."""

    socket: Path
    config: AxisConfig
    virtual: bool = False

    @property
    def identity(self) -> dict[str, Any]:
        """The configuration."""
        return {"name": self.config.name} | configured(self.config)

    @property
    def cutoff_hz(self) -> float | None:
        """As configured."""
        return self.config.encoder.velocity_cutoff_hz

    @contextlib.contextmanager
    def experiments(self) -> Iterator[Link]:
        """Over the daemon's control socket."""
        with ControlClient(self.socket) as client:
            yield DaemonLink(client, self.config)

    @contextlib.contextmanager
    def deployment(self, folder: Path, gains: GainSet, present: GainSet) -> Iterator[DeployLink]:
        """Over the daemon's control socket; the sets are in its own store. Raises BadInput on another configuration."""
        with ControlClient(self.socket) as client:
            require_daemon_config(client, self.config)
            yield DaemonDeployLink(client)


def configured(config: AxisConfig) -> dict[str, Any]:
    """What of a configuration makes another axis of it: cycle, devices and limits, without the velocity filter."""
    parts = config.model_dump(mode="json", include={"cycle", "amplifier", "encoder", "limits"})
    parts["encoder"].pop("velocity_cutoff_hz")
    return parts
