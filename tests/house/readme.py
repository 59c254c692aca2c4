"""The README's tables that come from the code. `python tests/house/readme.py` writes them anew.

With the file of `servoctl bench --out FILE` as argument it writes the measured figures too.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from servod.benchmark.table import GOALS
from servod.benchmark.table import shown as shown_figure
from servod.config import AxisConfig
from servod.drivers.quirks import QUIRKS
from servod.errors import FAULTS

README = Path(__file__).resolve().parents[2] / "README.md"


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def faults() -> str:
    """Every fault, its reaction, cause and remedy."""
    rows = [[f"`{f.code.name}`", f.reaction.name.lower().replace("_", " "), f.cause, f.remedy] for f in FAULTS.values()]
    return markdown(["Fault", "Reaction", "Cause", "Remedy"], rows)


def quirks() -> str:
    """Every documented deviation of a real drive, with its source."""
    rows = [
        [f"`{name}`", row.maker, deviation.text, deviation.source]
        for name, row in QUIRKS.items()
        for deviation in row.deviations
    ]
    return markdown(["`amplifier.quirks`", "Maker", "Deviation", "Source"], rows)


def config() -> str:
    """Every key of the axis configuration with its type and range, default and meaning."""
    schema = AxisConfig.model_json_schema()
    return markdown(["Key", "Allowed", "Default", "Meaning"], list(config_rows(schema, schema, "")))


def config_rows(schema: dict[str, Any], here: dict[str, Any], prefix: str) -> Iterator[list[str]]:
    """The rows of one level, groups followed by their keys."""
    for name, field in here["properties"].items():
        group = field.get("$ref")
        if group:
            yield from config_rows(schema, schema["$defs"][group.rsplit("/", 1)[1]], f"{prefix}{name}.")
            continue
        default = "required" if name in here.get("required", []) else f"`{shown(field)}`"
        yield [f"`{prefix}{name}`", allowed(field), default, field.get("description", "")]


def shown(field: dict[str, Any]) -> str:
    """A default as it would stand in the file."""
    default = field.get("default", {})
    if isinstance(default, bool):
        return str(default).lower()
    return "none" if default is None else str(default)


def allowed(field: dict[str, Any]) -> str:
    """Type and range of one key in words."""
    if "anyOf" in field:
        return " or ".join(allowed(option) for option in field["anyOf"])
    if "enum" in field:
        return ", ".join(str(value) for value in field["enum"])
    bounds = [f"{sign} {field[key]}" for key, sign in BOUNDS.items() if key in field]
    kind = {"null": "none", "string": "text", "object": "mapping"}.get(field.get("type", ""), field.get("type", ""))
    return " ".join([kind, ", ".join(bounds)]).strip()


BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
TABLES: dict[str, Callable[[], str]] = {"faults": faults, "quirks": quirks, "config": config}


def with_tables(text: str) -> str:
    """The README's text with all tables as the code has them now."""
    for name, table in TABLES.items():
        text = with_section(text, name, table())
    return text


def measured(document: dict[str, Any]) -> str:
    """The benchmark's figures beside their goals, and the machine they were measured on."""
    machine = document["machine"]
    rows = []
    for goal in GOALS:
        rows.append([goal.label, shown_figure(document, goal), goal.goal, goal.verdict(document)])
    wall_s, memory_s = document["wall_clock"]["seconds"], document["memory"]["seconds"]
    return (
        f"Measured by `servoctl bench` on {machine['cpu']}, {machine['cores']} cores, Linux {machine['kernel']}, "
        f"Python {machine['python']}; wall clock over {wall_s:.0f} s, memory over {memory_s:.0f} s.\n\n"
        + markdown(["Figure", "Measured", "Goal", ""], rows)
    )


def with_section(text: str, name: str, content: str) -> str:
    """`text` with the part between the marks of `name` replaced."""
    pattern = re.compile(rf"(<!-- {name}: from the code -->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    assert pattern.search(text), f"README.md has no part {name}"
    return pattern.sub(lambda m: f"{m[1]}{content}\n{m[2]}", text)


def main(arguments: list[str]) -> None:
    """Write the tables, and the measured figures when their file is given."""
    text = with_tables(README.read_text())
    if arguments:
        text = with_section(text, "measured", measured(json.loads(Path(arguments[0]).read_text())))
    README.write_text(text)


if __name__ == "__main__":
    main(sys.argv[1:])
