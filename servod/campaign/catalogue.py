"""The scenarios that ship: every YAML file under `scenarios/`, by its name without ending."""

from __future__ import annotations

from pathlib import Path

from servod.campaign.scenario import Scenario, load_scenarios

_FOLDER = Path(__file__).parent / "scenarios"


def shipped_scenarios() -> dict[str, Scenario]:
    """Name -> scenario, in the order of groups and names. Raises BadInput for a broken file."""
    return scenarios_in(_FOLDER)


def scenarios_in(folder: Path) -> dict[str, Scenario]:
    """All scenarios of a folder and its subfolders."""
    found: dict[str, Scenario] = {}
    for path in sorted(folder.rglob("*.yaml")):
        found |= load_scenarios(path)
    return dict(sorted(found.items(), key=lambda item: (item[1].group, item[0])))
