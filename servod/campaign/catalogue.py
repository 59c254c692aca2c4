"""The scenarios that ship: every YAML file under `scenarios/`, by its name without ending."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from servod.campaign.scenario import Scenario, load_scenarios
from servod.errors import BadInput

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
