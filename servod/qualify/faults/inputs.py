"""Plant and configuration of a scenario: what its file states, laid over what ships.

Used by every axis under test before it starts.
"""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.config import AxisConfig, load_config
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.qualify.faults.scenario import Scenario

Nested = dict[str, Any]


#: The wiring was proven at an enable long ago; a scenario that is about the proof asks for it.
PROVEN_BEFORE = {"wiring_proof": {"enabled": False}}


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


def config_of(scenario: Scenario, base: Nested) -> AxisConfig:
    """The axis: the scenario's keys over `base`. Raises BadInput."""
    return validate(merged(base, scenario.config), AxisConfig, f"{scenario.title}: config")


def merged(base: Nested, over: Nested) -> Nested:
    """`over` laid over `base`, mapping by mapping."""
    result = dict(base)
    for key, value in over.items():
        old = base.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result
