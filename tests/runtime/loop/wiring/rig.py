"""An axis whose joint, sensors and drive are what a test says, and whose configuration may say otherwise."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from servod.client.stepped import SteppedSession
from servod.client.virtual import rated_torque_mnm, virtual_config
from servod.common.yaml import validate
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import AxisConfig
from servod.formats.model.axis_model import AxisModel
from servod.kernels.laws import LAWS
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, Refusal
from servod.runtime.loop.wiring.findings import WiringOutcome, WiringReport


def joint(**changes: Any) -> AxisModel:
    """Table I's joint, with changed keys."""
    friction = {"kind": "lugre", "sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056, "coulomb": 0.045, "static": 0.07}
    return validate({"inertia": 0.001, "friction": friction, **changes}, AxisModel, "joint")


def stronger(factor: float, inertia: float = 0.001) -> AxisModel:
    """Table I's joint on a drive that gives `factor` times the torque it is asked for: all else is so much less."""
    friction = {
        key: value / factor
        for key, value in {"sigma0": 950.0, "sigma1": 1.0, "viscous": 0.056, "coulomb": 0.045, "static": 0.07}.items()
    }
    return joint(inertia=inertia / factor, friction={"kind": "lugre", **friction})


class Outcome(NamedTuple):
    """How enabling ended, and what the joint really did meanwhile."""

    session: SteppedSession
    proof: WiringReport
    furthest_rad: float
    fastest_rad_s: float

    @property
    def finding(self) -> WiringOutcome:
        return WiringOutcome(self.proof.finding)

    @property
    def enabled(self) -> bool:
        return self.session.cycle.axis.state == AxisState.ENABLED


def axis(plant: AxisModel, config: dict[str, Any] | None = None, **devices: Any) -> SteppedSession:
    """The axis of `plant`; `config`: groups of keys that replace those that suit, `devices`: what they really are.

    With `bought_for`, drive and limits suit that joint instead.
    """
    rated = rated_torque_mnm(devices.pop("bought_for", plant))
    keys = virtual_config(Path(tempfile.gettempdir()), rated, devices.get("encoder_counts_per_turn", 2**20))
    document = keys.model_dump(mode="json")
    document["limits"]["speed_rad_s"] = 10.0
    for group, values in (config or {}).items():
        document[group] = {**document[group], **values} if isinstance(values, dict) else values
    settings = VirtualAxisSettings(**{"rated_torque_mnm": rated, **devices})
    world = SteppedWorld(settings, plant)
    law = LAWS["pd"]
    return SteppedSession(validate(document, AxisConfig, "test"), world, law.number, (0.0,) * law.n_parameters)


def enable(session: SteppedSession, *arguments: float, watch_s: float = 0.0) -> Outcome:
    """Enable it, looking at the truth in every cycle, `watch_s` longer than it takes."""
    session.run(0.01)
    start = session.world.truth().position_rad
    assert session.send(Op.ENABLE, arguments) == Refusal.DONE
    furthest = fastest = 0.0
    cycles = left = round(watch_s * 1000)
    for _ in range(9000):
        session.run(0.001)
        truth = session.world.truth()
        furthest, fastest = max(furthest, abs(truth.position_rad - start)), max(fastest, abs(truth.velocity_rad_s))
        under_way = session.cycle.axis.state in (AxisState.ENABLING, AxisState.PROVING)
        left = cycles if under_way else left - 1
        if left < 0:
            break
    assert session.proof is not None
    return Outcome(session, session.proof, furthest, fastest)


def proven(plant: AxisModel, config: dict[str, Any] | None = None, **devices: Any) -> Outcome:
    """Bring up and enable for the first time."""
    return enable(axis(plant, config, **devices), watch_s=0.2)
