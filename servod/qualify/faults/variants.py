"""Several scenarios in one file: `for_each` lists rows of values, and `$key` in the rest of the file stands for them.

A row has a `name`; its scenario is `file/name`. Where `$key` is a whole value, the row's value takes its place as
it is (a number, a list); inside a longer text it is put in as text. Between file and schema
(servod.qualify.faults.scenario).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from servod.common.errors import BadInput
from servod.common.yaml import parse_yaml, read_text, validate
from servod.qualify.faults.actions import action_of
from servod.qualify.faults.evidence import check_strays
from servod.qualify.faults.judge import check_bounds
from servod.qualify.faults.scenario import Scenario, check_inputs

_KEY, _NAME = "for_each", "name"
_PLACE = re.compile(r"\$([a-z_]+)")


def variants(path: Path) -> Iterator[tuple[str, Any, str]]:
    """(name, data, where) of each scenario in the file at `path`. Raises BadInput."""
    data, where = parse_yaml(read_text(path), str(path)), str(path)
    if not isinstance(data, dict) or _KEY not in data:
        yield path.stem, data, where
        return
    common = {key: value for key, value in data.items() if key != _KEY}
    rows = data[_KEY]
    if not isinstance(rows, list) or not rows:
        raise BadInput(f"{where}: {_KEY}", repr(rows)[:80], "a list of rows, each with its values")
    names: set[str] = set()
    for number, row in enumerate(rows):
        here = f"{where}: {_KEY}.{number}"
        name = _name(row, here, names)
        names.add(name)
        filling = _Filling(row, here)
        filled = filling.filled(common)
        filling.check_all_read()
        yield f"{path.stem}/{name}", filled, f"{where} ({name})"


def _name(row: Any, where: str, taken: set[str]) -> str:
    name = row.get(_NAME) if isinstance(row, dict) else None
    if name is None or str(name) in taken:
        raise BadInput(where, repr(row)[:80], "a mapping with a `name` that no other row has")
    return str(name)


class _Filling:
    """Puts the values of one row in their places, and knows which were read."""

    def __init__(self, row: dict[str, Any], where: str) -> None:
        self._row, self._where = row, where
        self._unread = row.keys() - {_NAME}

    def filled(self, value: Any) -> Any:
        """`value` with every `$key` replaced from the row. Raises BadInput for one that the row has not."""
        if isinstance(value, dict):
            return {key: self.filled(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.filled(item) for item in value]
        if not isinstance(value, str):
            return value
        whole = _PLACE.fullmatch(value)
        if whole:
            return self._of(whole[1])
        return _PLACE.sub(lambda match: str(self._of(match[1])), value)

    def check_all_read(self) -> None:
        """Raises BadInput for a key of the row that nothing reads."""
        if self._unread:
            key = min(self._unread, key=str)
            raise BadInput(f"{self._where}.{key}", "a value that nothing reads", f"a key that the file has as ${key}")

    def _of(self, key: str) -> Any:
        if key not in self._row:
            raise BadInput(self._where, f"no {key}", f"a value for ${key}")
        self._unread -= {key}
        return self._row[key]


# --- Files of scenarios ----------------------------------------------------------------------------------------------
# Scenarios from their files, checked as a whole: those that ship, every YAML file under `scenarios/`, and others.


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
