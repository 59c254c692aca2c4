"""What shows each requirement of safety, and the software of others that servod is made with: two tables of the manual.

`safety_trace.yaml` names hazards of docs/safety.md, scenarios of the fault campaign, files of tests/cycles and tests;
what is not there is an error, and so is a hazard without a requirement, or a scenario that shows nothing.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import NamedTuple

import yaml
from tables import markdown

from servod.qualify.faults.variants import shipped_scenarios

ROOT = Path(__file__).resolve().parents[2]
#: Where each lock is installed; what is in several counts where it comes first.
LOCKS = {"deploy": "beside the axis", "sign": "beside the axis, with the extra `sign`", "lab": "at the desk"}
_PINNED = re.compile(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)", re.MULTILINE)


class Requirement(NamedTuple):
    """One requirement, the hazards that it answers, and what shows that it is met."""

    id: str
    requirement: str
    hazards: list[str]
    shown_by: list[str]


@cache
def requirements() -> list[Requirement]:
    """Those of safety_trace.yaml."""
    return [Requirement(**one) for one in yaml.safe_load((ROOT / "tests/tools/safety_trace.yaml").read_text())]


@cache
def hazards() -> dict[str, str]:
    """Number and name of each row of the hazard table of docs/safety.md."""
    part = (ROOT / "docs/safety.md").read_text().split("\n## Hazards\n")[1].split("\n## ")[0]
    return dict(re.findall(r"^\| (H\d+) \| ([^|]+) \|", part, re.MULTILINE))


@cache
def _scenarios() -> dict[str, object]:
    return dict(shipped_scenarios())


@cache
def scenarios_of(evidence: str) -> list[str]:
    """The scenarios that an entry `scenario NAME` or `scenario GROUP/*` names."""
    name = evidence.removeprefix("scenario ")
    group = name.removesuffix("*")
    return [s for s in _scenarios() if s == name or (group != name and s.startswith(group))]


def missing(evidence: str) -> bool:
    """Whether what an entry names does not exist."""
    kind, name = evidence.split(" ", 1)
    if kind == "scenario":
        return not scenarios_of(evidence)
    if kind == "cycle":
        return not (ROOT / f"tests/cycles/{name}.yaml").is_file()
    file, function = name.split("::")
    return not (ROOT / file).is_file() or function not in _tests_of(ROOT / file)


def unused_scenarios() -> list[str]:
    """Scenarios of the campaign that no requirement names."""
    used = {s for one in requirements() for evidence in one.shown_by for s in scenarios_of(evidence)}
    return sorted(set(_scenarios()) - used)


def requirement_table() -> str:
    """Each requirement with what shows it."""
    rows = [
        [r.id, r.requirement, ", ".join(f"{h} {hazards()[h]}" for h in r.hazards), ", ".join(map(_shown, r.shown_by))]
        for r in requirements()
    ]
    return markdown(["", "Requirement", "Hazards", "Shown by"], rows)


def supply_table() -> str:
    """Each library of the locks: version, licence, and whether it runs beside the axis."""
    where: dict[tuple[str, str], str] = {}
    for lock, place in LOCKS.items():
        for pinned in _PINNED.findall((ROOT / f"requirements/{lock}.txt").read_text()):
            where.setdefault(pinned, place)
    rows = [[f"`{name}`", version, _licence(name), place] for (name, version), place in sorted(where.items())]
    return markdown(["Library", "Version of the lock", "Licence", "Runs"], rows)


def _shown(evidence: str) -> str:
    kind, name = evidence.split(" ", 1)
    if kind == "scenario":
        count = len(scenarios_of(evidence))
        return f"`{name}`" + (f" ({count})" if count > 1 else "")
    return f"`tests/cycles/{name}.yaml`" if kind == "cycle" else f"`{name.removeprefix('tests/')}`"


@cache
def _tests_of(file: Path) -> set[str]:
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    return {node.name for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, functions)}


def _licence(name: str) -> str:
    """What the installed library says of its licence, in few words."""
    try:
        told = metadata(name)
    except PackageNotFoundError:
        return "not installed here"
    classified = [c.rsplit("::", 1)[-1].strip() for c in told.get_all("Classifier") or () if c.startswith("License ::")]
    said = told.get("License-Expression") or ", ".join(classified) or (told.get("License") or "").split("\n")[0]
    return said[:60] or "see its page"


def complaints() -> Iterator[str]:
    """Everything that is wrong with safety_trace.yaml."""
    answered = {hazard for one in requirements() for hazard in one.hazards}
    for one in requirements():
        yield from (f"{one.id}: there is no {evidence}" for evidence in one.shown_by if missing(evidence))
        yield from (f"{one.id}: docs/safety.md has no hazard {h}" for h in one.hazards if h not in hazards())
    yield from (f"no requirement answers the hazard {h}" for h in hazards() if h not in answered)
    yield from (f"no requirement names the scenario {name}" for name in unused_scenarios())
