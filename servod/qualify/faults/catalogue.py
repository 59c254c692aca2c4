"""Scenarios from their files, checked as a whole: those that ship, every YAML file under `scenarios/`, and others.

Above the schema, for only actions, inputs and judge know what a scenario may ask of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from servod.common.errors import BadInput
from servod.common.yaml import validate
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.evidence import check_strays
from servod.qualify.faults.inputs import check_inputs
from servod.qualify.faults.losses import check_bounds
from servod.qualify.faults.scenario import Scenario
from servod.qualify.faults.variants import variants

_FOLDER = Path(__file__).parent / "scenarios"


def shipped_scenarios() -> dict[str, Scenario]:
    """Name -> scenario, in the order of groups and names. Raises BadInput for a broken file."""
    return scenarios_in(_FOLDER)


def scenarios_in(folder: Path) -> dict[str, Scenario]:
    """All scenarios of a folder and its subfolders."""
    found = load_all(sorted(folder.rglob("*.yaml")))
    return dict(sorted(found.items(), key=lambda item: (item[1].group, item[0])))


def load_all(paths: Iterable[Path]) -> dict[str, Scenario]:
    """The scenarios of all these files, in their order. Raises BadInput, also for a name that comes twice."""
    found: dict[str, Scenario] = {}
    for path in paths:
        more = load_scenarios(path)
        if twice := found.keys() & more.keys():
            raise BadInput(str(path), f"a second scenario {min(twice)}", "a file name that no other folder has")
        found |= more
    return found


def load_scenarios(path: str | Path) -> dict[str, Scenario]:
    """Read the scenarios of one file by name; raises BadInput (file, key, found, allowed), also for a wrong action."""
    return {name: _checked(data, where) for name, data, where in variants(Path(path))}


def _checked(data: Any, where: str) -> Scenario:
    scenario = validate(data, Scenario, where)
    check_inputs(scenario, where)
    for key, injections in (("inject", scenario.inject), ("mend", scenario.mend)):
        for number, injection in enumerate(injections):
            action_of(injection, f"{where}: {key}.{number}", scenario.runs)
    check_bounds(scenario, where)
    check_strays(scenario, where)
    return scenario
