"""The scenarios that ship: every YAML file under `scenarios/`, by its name without ending."""

from __future__ import annotations

from pathlib import Path

from servod.campaign.scenario import Scenario, load_scenarios
from servod.errors import BadInput

_FOLDER = Path(__file__).parent / "scenarios"


def shipped_scenarios() -> dict[str, Scenario]:
    """Name -> scenario, in the order of groups and names. Raises BadInput for a broken file."""
    return scenarios_in(_FOLDER)


def scenarios_in(folder: Path) -> dict[str, Scenario]:
    """All scenarios of a folder and its subfolders."""
    found: dict[str, Scenario] = {}
    for path in sorted(folder.rglob("*.yaml")):
        more = load_scenarios(path)
        if twice := found.keys() & more.keys():
            raise BadInput(str(path), f"a second scenario {min(twice)}", "a file name that no other folder has")
        found |= more
    return dict(sorted(found.items(), key=lambda item: (item[1].group, item[0])))
