"""A fault scenario as its file states it: what is injected when, what must happen, and how one recovers.

One YAML file is one scenario, or several that differ in a few values (`servod.qualify.faults.variants`). What an
injection does stands in `servod.qualify.faults.actions`.
"""

from __future__ import annotations

import copy
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, model_validator

from servod.common.faults import FaultCode
from servod.common.shipped import shipped
from servod.common.yaml import Strict, validate
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import AxisConfig, load_config
from servod.formats.joint_bounds import joint_of
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.wiring.findings import WiringOutcome

#: After a loss of the master the torque must be gone within this time [ms].
MASTER_LOSS_MS = 300.0
#: After a loss of feedback the drive must have left the controller's command within this time [ms].
FEEDBACK_LOSS_MS = 50.0

AXIS_STATES = {state.name for state in AxisState}
FAULT_NAMES = {code.name for code in FaultCode}
DRIVE_STATES = {state.name for state in DriveState}
FINDINGS = {finding.name for finding in WiringOutcome}


class Runs(StrEnum):
    """Which axis under test shows the scenario."""

    STEPPED = "stepped"  # one process, virtual time, exact
    PROCESSES = "processes"  # daemon, loop and virtual axis as processes, wall clock
    GUEST = "guest"  # systemd and a real vcan in the guest machine


class ScenarioStart(StrEnum):
    """What the axis is doing when the first injection comes."""

    OFF = "off"  # before the bring-up, which is then tried
    DISABLED = "disabled"
    ENABLED = "enabled"  # at rest under control
    MOVING = "moving"  # in the middle of a sine, at its fastest, with friction to overcome
    PROVING = "proving"  # in the test of the wiring, while it pushes the joint

    @property
    def powered(self) -> bool:
        """The drive has power, so that there is something to lose."""
        return self in (ScenarioStart.ENABLED, ScenarioStart.MOVING, ScenarioStart.PROVING)


class Loss(StrEnum):
    """What a scenario takes from the axis. Its actions say so (servod.qualify.faults.judge); each loss has its
    bound."""

    NONE = "none"
    FEEDBACK = "feedback"
    MASTER = "master"


class Recovery(StrEnum):
    """What a person does afterwards, so that the axis can be enabled again."""

    NONE = "none"  # nothing to do: it never stopped
    ENABLE = "enable"
    RESET_FAULT = "reset_fault"  # enable with --reset-fault
    RESTART = "restart"  # restart the daemon, then enable
    REPAIR = "repair"  # only a person at the hardware or the configuration mends it


class Injection(Strict):
    """One thing that goes wrong: `do` has one key, the name of an action, with its arguments."""

    at_ms: float = Field(0.0, ge=0.0, le=600_000.0)
    do: dict[str, dict[str, Any]]
    timed: bool = Field(False, description="times count from here, not from the first injection")

    @model_validator(mode="after")
    def _one_action(self) -> Injection:
        if len(self.do) != 1:
            raise ValueError("one action for each injection")
        return self

    @property
    def action(self) -> str:
        """Name of the action."""
        return next(iter(self.do))

    @property
    def arguments(self) -> dict[str, Any]:
        """What the action is told."""
        return self.do[self.action]


def _one_of(names: set[str]) -> AfterValidator:
    """A word that is one of `names`; the message stands at the word itself."""

    def check(word: str) -> str:
        if word not in names:
            raise ValueError(f"one of {', '.join(sorted(names))}")
        return word

    return AfterValidator(check)


AxisWord = Annotated[str, _one_of(AXIS_STATES)]
FaultWord = Annotated[str, _one_of(FAULT_NAMES)]
DriveWord = Annotated[str, _one_of(DRIVE_STATES)]
FindingWord = Annotated[str, _one_of(FINDINGS)]


class Expectation(Strict):
    """What must happen. Times count from the timed or first injection, on the drive's side, in bus time."""

    exempt: str | None = Field(None, min_length=20, description="why the bound of a loss does not hold here, in words")
    coasts: str | None = Field(
        None, min_length=20, description="why no ramp of the drive brings the joint to rest here, in words"
    )
    unstated: str | None = Field(
        None, min_length=20, description="why servod's statement of a stop is not about this one, in words"
    )
    axis: list[AxisWord] = Field(
        min_length=1, description="names of servod.runtime.loop.axis_state.AxisState; one of them at the end"
    )
    faults: list[FaultWord] = Field(
        [], description="names of servod.common.faults.FaultCode; one of them at least is latched"
    )
    never_told: list[FaultWord] = Field([], description="names of servod.common.faults.FaultCode, none is latched")
    reaction_ms: float | None = Field(None, gt=0.0, description="the drive has left the controller's command by then")
    torque_gone_ms: float | None = Field(None, gt=0.0, description="the joint feels no torque from then on")
    refused: str | None = Field(None, description="words of the message with which the bring-up or command is refused")
    says: FindingWord | None = Field(
        None, description="name of servod.runtime.loop.wiring.findings.WiringOutcome: what the wiring test tells"
    )
    lost_records: int = Field(0, ge=0, description="cycle records that may be missing")
    drive_error: int | None = Field(None, gt=0, le=0xFFFF, description="the error code that the user is shown")
    strays_rad: float = Field(0.03, gt=0.0, description="an axis that stays enabled: distance from its motion")
    fastest_rad_s: float = Field(2.0, gt=0.0, description="an axis that stays enabled: speed of the joint")
    sinks_rad: float | None = Field(
        None, gt=0.0, description="an axis that starts at rest: the joint stays this near to where it was"
    )
    most_nm: float | None = Field(None, gt=0.0, description="the joint feels no more torque than this")
    drive_shows: list[DriveWord] = Field(
        [], description="names of servod.runtime.fieldbus.devices.DriveState, all seen after the injection"
    )
    drive_never: list[DriveWord] = Field(
        [], description="names of servod.runtime.fieldbus.devices.DriveState, none seen after the injection"
    )

    @model_validator(mode="after")
    def _one_outcome(self) -> Expectation:
        if self.stays_enabled and len(self.axis) > 1:
            raise ValueError("either ENABLED alone or the states of an axis that was stopped: a scenario has one end")
        return self

    @property
    def stays_enabled(self) -> bool:
        """The axis goes on."""
        return AxisState.ENABLED.name in self.axis


class Scenario(Strict):
    """One scenario."""

    title: str = Field(min_length=1, max_length=100)
    why: str = Field(min_length=1, description="when this happens to a machine, in a sentence")
    group: str = Field(min_length=1, description="heading in the table: bus, drive, encoder, process, ...")
    runs: Runs = Runs.STEPPED
    start: ScenarioStart = ScenarioStart.MOVING
    waits: bool = Field(False, description="the daemon runs as the unit runs it, with --wait; the guest's always does")
    settings: dict[str, Any] = Field({}, description="of the virtual axis, over its defaults")
    config: dict[str, Any] = Field(
        {},
        description="of the axis, over the shipped virtual.yaml; nested; wiring_proof.enabled is false unless stated",
    )
    plant: dict[str, Any] = Field({}, description="of the plant's axis model, over the demo joint")
    inject: list[Injection] = Field(min_length=1)
    watch_ms: float = Field(1000.0, gt=0.0, le=600_000.0, description="how long the axis is watched afterwards")
    expect: Expectation
    mend: list[Injection] = Field([], description="what takes the cause away, before one recovers")
    mend_ms: float = Field(0.0, ge=0.0, le=600_000.0, description="time that passes then")
    recover: Recovery = Recovery.RESET_FAULT

    @model_validator(mode="after")
    def _torque_has_a_bound(self) -> Scenario:
        if self.start is not ScenarioStart.OFF and not self.expect.stays_enabled and self.expect.torque_gone_ms is None:
            raise ValueError("expect.torque_gone_ms: an axis that does not stay enabled has a time for it")
        return self

    @model_validator(mode="after")
    def _sinks_from_rest(self) -> Scenario:
        if self.expect.sinks_rad is not None and self.start is not ScenarioStart.ENABLED:
            raise ValueError("expect.sinks_rad is for start: enabled")
        return self

    @model_validator(mode="after")
    def _runs_can_show_it(self) -> Scenario:
        if self.runs is not Runs.STEPPED and (
            self.start is ScenarioStart.PROVING or self.expect.drive_error is not None
        ):
            raise ValueError("start: proving and expect.drive_error are for runs: stepped")
        return self


# --- Plant and configuration -----------------------------------------------------------------------------------------
# Plant and configuration of a scenario: what its file states, laid over what ships.


Nested = dict[str, Any]


#: The wiring was proven at an enable long ago; a scenario that is about the proof asks for it.
PROVEN_BEFORE = {"wiring_proof": {"enabled": False}}
#: In virtual time nobody is late: the drive is held to the deadline of a real one, not to that of a shared processor.
PUNCTUAL = {"heartbeat": {"command_deadline_ms": 20}}


def shipped_config() -> Nested:
    """The shipped configuration of the virtual axis, its paths made absolute."""
    return copy.deepcopy(_shipped_config())


@cache
def _shipped_config() -> Nested:
    return load_config(shipped("gains/config/virtual.yaml")).model_dump(mode="json", exclude_none=True)


def plant_of(scenario: Scenario) -> AxisModel:
    """The joint: the scenario's keys over the demo joint. Raises BadInput."""
    return _plant(scenario, scenario.title)


def check_inputs(scenario: Scenario, where: str) -> None:
    """What the scenario says of settings, configuration and plant, before anything runs. Raises BadInput."""
    validate(scenario.settings, VirtualAxisSettings, f"{where}: settings")
    if scenario.config:
        over = merged(PROVEN_BEFORE, scenario.config)
        validate(merged(_shipped_config(), over), AxisConfig, f"{where}: config")
    if scenario.plant:
        _plant(scenario, where)


def _plant(scenario: Scenario, where: str) -> AxisModel:
    return validate(merged(_demo_joint(), scenario.plant), AxisModel, f"{where}: plant")


@cache
def _demo_joint() -> Nested:
    return load_axis_model(shipped("gains/axes/demo_joint.yaml")).model_dump(mode="json", exclude_none=True)


def demo_effects() -> list[str]:
    """Names of the groups that the demo joint has: a plant sets them null to have none of them."""
    model = validate(_demo_joint(), AxisModel, "demo joint")
    return [name for name, _ in model.groups()]


def config_of(scenario: Scenario, base: Nested) -> AxisConfig:
    """The axis: the scenario's keys over `base`. Raises BadInput."""
    return validate(merged(base, scenario.config), AxisConfig, f"{scenario.title}: config")


def known_joint(scenario: Scenario, config: AxisConfig, folder: Path) -> AxisConfig:
    """`config` with the section stopping as an engineer states it who has identified the scenario's joint, so that
    every stop is held against a statement; one that it has stays. What is wrong with the drive's torque he does not
    know. `folder` takes the model. Raises BadInput."""
    if config.stopping.least_inertia is not None:
        return config
    path = folder / "joint.yaml"
    path.write_text(axis_model_yaml(plant_of(scenario)))
    joint = joint_of(config.model_copy(update={"model": path}))
    if joint is None:
        return config
    bounds = {
        "least_inertia": joint.least_inertia,
        "most_inertia": joint.most_inertia,
        "least_friction_nm": joint.friction_nm,
        "least_viscous": joint.viscous,
        "load_min_nm": joint.load_min_nm,
        "load_max_nm": joint.load_max_nm,
    }
    bounds = {key: joint.torque_factor * value for key, value in bounds.items()}
    return config.model_copy(update={"stopping": config.stopping.model_copy(update=bounds)})


def merged(base: Nested, over: Nested) -> Nested:
    """`over` laid over `base`, mapping by mapping."""
    result = dict(base)
    for key, value in over.items():
        old = base.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result
