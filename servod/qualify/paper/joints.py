"""The virtual axes that the paper is done on: Table I's joint, and the same joint with what real ones have.

Under the experiments. The paper's laboratory joint is asymmetric, Table I is not; the second joint (the demo's) adds
30 % of asymmetry, cogging, warming and noise, of which no law is told beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path

from servod.client.stepped import SteppedAxis
from servod.client.virtual import rated_torque_mnm, virtual_config, virtual_session
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.gains.parameters import LocalParameters, LocalSet
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.report.figures.sets import local_law
from servod.lab.synthesize.gain_set import with_feedback
from servod.qualify.paper.printed import FRICTION, K_D, K_P, L_I

#: Encoder of the paper's runs here; the paper does not print its own.
ENCODER_COUNTS = 2**20
#: Cut-off of the velocity filter under the paper's gain sets, as the demo has it; synthesized sets bring their own.
CUTOFF_HZ = 120.0
#: Speed limit while gain sets are compared: the gains of Table I turn the joint at 3.6 rad/s after a step of 100 mrad.
STEP_SPEED_RAD_S = 10.0


class PaperJoint(Enum):
    """A virtual joint by the file of its model."""

    TABLE1 = "table1_joint"
    REAL = "demo_joint"

    @property
    def label(self) -> str:
        """What people read."""
        return {"table1_joint": "Table I's joint", "demo_joint": "asymmetric joint"}[self.value]

    def model(self) -> AxisModel:
        """The plant."""
        return load_axis_model(shipped(f"gains/axes/{self.value}.yaml"))


def open_axis(joint: PaperJoint, folder: Path, seed: int) -> SteppedAxis:
    """The virtual axis for its identification, SYNC-stepped and disabled."""
    return SteppedAxis(virtual_session(joint.model(), folder, ENCODER_COUNTS, seed), folder)


def open_for_tracking(joint: PaperJoint, folder: Path, seed: int, cutoff_hz: float) -> SteppedAxis:
    """The same axis with the velocity filter of the gain set that is to run, and room for the steps of section V."""
    plant = joint.model()
    found = virtual_config(folder, rated_torque_mnm(plant), ENCODER_COUNTS)
    encoder = found.encoder.model_copy(update={"velocity_cutoff_hz": cutoff_hz})
    limits = found.limits.model_copy(update={"speed_rad_s": STEP_SPEED_RAD_S})
    config = found.model_copy(update={"encoder": encoder, "limits": limits})
    return SteppedAxis(virtual_session(plant, folder, ENCODER_COUNTS, seed, config), folder)


# --- Gain sets of the paper ------------------------------------------------------------------------------------------
# Gain sets of the paper in every reading, and variants of them for the sweeps.


def shipped_set(name: str) -> GainSet:
    """A gain set of the folder gains."""
    return load_gains(shipped(f"gains/{name}.yaml"))


def with_l(gains: GainSet, name: str, values: Sequence[float]) -> GainSet:
    """The same set with other l_i, in the order of its nodes."""
    law = local_law(gains)
    sets = [s.model_copy(update={"gain": l_i}) for s, l_i in zip(law.friction.sets, values, strict=True)]
    return _with_sets(gains, name, law, sets)


def printed_l(gains: GainSet) -> GainSet:
    """l_i as Table I prints them, signs included."""
    return with_l(gains, "table1_printed_l", L_I)


def with_decays(gains: GainSet, name: str, decay: Callable[[float], float], nodes: Sequence[float]) -> GainSet:
    """The same set with other local sets: a_i from `decay` of v_i, without l_i."""
    sets = [LocalSet(velocity_rad_s=v, decay_per_s=decay(v) if v else 0.0) for v in nodes]
    return _with_sets(gains, name, local_law(gains), sets)


def at_paper_feedback(gains: GainSet, name: str, observer_rad_s: float | None = None) -> GainSet:
    """The compensation of `gains` under the paper's PD gains."""
    return with_feedback(gains, name, K_P, K_D, observer_rad_s)


def without_observer(gains: GainSet, name: str) -> GainSet:
    """The set without its disturbance observer, driven by the measured velocity; its feed-forwards and widths stay."""
    from servod.formats.gains.parameters import VelocitySource

    law = local_law(gains)
    friction = law.friction.model_copy(update={"velocity": VelocitySource.MEASURED, "lead_s": 0.0})
    return with_law(gains, name, law.model_copy(update={"friction": friction, "disturbance_observer": None}))


def consistent_g(speed: float) -> float:
    """g(v) of (18) with the exponent -(v/v_s)^2 [N*m]."""
    f = FRICTION
    return f.coulomb + (f.static - f.coulomb) * math.exp(-((speed / f.stribeck_velocity) ** 2))


def printed_g(speed: float) -> float:
    """g(v) of (18) as printed, with the exponent +(v/v_s)^2 [N*m]."""
    f = FRICTION
    return f.coulomb + (f.static - f.coulomb) * math.exp((speed / f.stribeck_velocity) ** 2)


def _with_sets(gains: GainSet, name: str, law: LocalParameters, sets: list[LocalSet]) -> GainSet:
    return with_law(gains, name, law.model_copy(update={"friction": law.friction.model_copy(update={"sets": sets})}))


def with_law(gains: GainSet, name: str, law: LocalParameters) -> GainSet:
    """The set with another law; what was changed is neither designed nor certified."""
    none = {"design": None, "certificate": None, "seal": None}
    return gains.model_copy(update={"name": name, "parameters": law, **none})
