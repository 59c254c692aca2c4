"""Plant and configuration of a scenario: what its file states, laid over what ships.

Used by every axis under test before it starts.
"""

from __future__ import annotations

from typing import Any

from servod.axis_model import AxisModel, load_axis_model
from servod.campaign.scenario import Scenario
from servod.config import AxisConfig, load_config
from servod.shipped import shipped
from servod.yaml12 import validate

Nested = dict[str, Any]


def shipped_config() -> Nested:
    """The shipped configuration of the virtual axis, its paths made absolute."""
    return load_config(shipped("gains/config/virtual.yaml")).model_dump(mode="json", exclude_none=True)


def plant_of(scenario: Scenario) -> AxisModel:
    """The joint: the scenario's keys over the demo joint. Raises BadInput."""
    base = load_axis_model(shipped("gains/axes/demo_joint.yaml")).model_dump(mode="json", exclude_none=True)
    return validate(merged(base, scenario.plant), AxisModel, f"{scenario.title}: plant")


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
