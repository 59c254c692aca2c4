"""The axis of `servoctl demo --diagnose`: tracks (19) and motions for a diagnosis, SYNC-stepped or under a daemon.

Beside the data path; a client like any other. Both kinds leave their cycles in the daemon's own recording format.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from servod.client.deploy_daemon import DaemonDeployLink
from servod.client.deploy_virtual import virtual_link, with_cutoff
from servod.client.links import DeployLink, Rows, SteppedDeployLink
from servod.client.virtual import ENCODER_COUNTS, rated_torque_mnm, virtual_config
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel, axis_model_yaml
from servod.lab.recordings.rows import ROW
from servod.lab.tracking.motions import REST_S
from servod.qualify.demo.axis import last_core, own_group
from servod.runtime.loop.commands import ReferenceKind


class RecoveryAxis(Protocol):
    """An enabled axis under one gain set."""

    @property
    def link(self) -> DeployLink:
        """The axis as a deployment sees it."""
        ...

    def paper(self, duration_s: float) -> Rows:
        """Track trajectory (19); the cycles of the motion. Raises AnswerIsNo when the axis drops out."""
        ...

    def follow(self, positions_rad: Sequence[float]) -> Rows:
        """Follow positions, one for each cycle; the cycles of the motion. Raises AnswerIsNo."""
        ...


class SteppedAxis:
    """In virtual time."""

    def __init__(self, link: SteppedDeployLink) -> None:
        self.link = link

    def paper(self, duration_s: float) -> Rows:
        """Trajectory (19)."""
        return self._move(ReferenceKind.PAPER, [duration_s])

    def follow(self, positions_rad: Sequence[float]) -> Rows:
        """Positions from the table that the loop shares."""
        self.link.session.load_trajectory(positions_rad)
        return self._move(ReferenceKind.TABLE, [len(positions_rad), min(positions_rad), max(positions_rad)])

    def _move(self, kind: ReferenceKind, arguments: Sequence[float]) -> Rows:
        session = self.link.session
        session.run(REST_S)
        session.clear()
        session.move(kind, arguments)
        return moving(np.frombuffer(session.raw, dtype=ROW))


class DaemonAxis:
    """On the wall clock, over the control socket."""

    def __init__(self, link: DaemonDeployLink) -> None:
        self.link = link

    def paper(self, duration_s: float) -> Rows:
        """Trajectory (19), as the daemon recorded it."""
        return moving(self.link.record([{"kind": "paper", "duration_s": duration_s}]))

    def follow(self, positions_rad: Sequence[float]) -> Rows:
        """Positions, as the daemon recorded them."""
        return moving(self.link.record([{"kind": "csv", "positions_rad": list(positions_rad)}]))


def moving(rows: Rows) -> Rows:
    """The cycles in which a motion ran."""
    motion: Rows = rows[rows["reference_active"] == 1]
    return motion


def config_for(plant: AxisModel, gains: GainSet, folder: Path) -> AxisConfig:
    """Configuration of a virtual axis with this joint, and the velocity filter that the set was designed for."""
    assert gains.design is not None  # it was synthesized
    config = virtual_config(folder, rated_torque_mnm(plant), ENCODER_COUNTS)
    return with_cutoff(config, gains.design.velocity_cutoff_hz)


@contextlib.contextmanager
def stepped_axis(plant: AxisModel, gains: GainSet, folder: Path, seed: int) -> Iterator[RecoveryAxis]:
    """A stepped axis, enabled under `gains`; its store is in `folder`."""
    link = virtual_link(plant, folder, gains, gains, seed, config_for(plant, gains, folder))
    link.enable()
    yield SteppedAxis(link)


@contextlib.contextmanager
def daemon_axis(plant: AxisModel, gains: GainSet, folder: Path, _seed: int) -> Iterator[RecoveryAxis]:
    """Daemon and virtual axis as processes, enabled under `gains`. Raises Unreachable when one does not start."""
    from servod.qualify.demo.wall import running_axis

    config = config_for(plant, gains, folder)
    joint, initial = folder / "plant.yaml", folder / "initial.yaml"
    joint.write_text(axis_model_yaml(plant))
    initial.write_text(gains.to_yaml())
    cycle = config.cycle.model_copy(update={"cpu": last_core(), "priority": 80})
    limits = config.limits.model_copy(update={"stale_cycles": 50, "late_cycles": 500})
    kept = config.gains.model_copy(update={"directory": folder / "gains", "initial": initial})
    control = config.control.model_copy(update={"socket": folder / "axis.sock", "group": own_group()})
    changed = {"cycle": cycle, "limits": limits, "gains": kept, "control": control}
    drive = ("--rated-torque-mnm", str(rated_torque_mnm(plant)))
    with running_axis(config.model_copy(update=changed), joint, folder, drive) as (client, _):
        link = DaemonDeployLink(client)
        link.enable()
        yield DaemonAxis(link)
        link.disable()
