"""The keys of an axis configuration as a table: type, unit, default, range and meaning, from the file model itself.

Beside servod.formats.config; `servoctl config keys` and docs/reference print it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from servod.formats.config import AxisConfig

#: Unit by the end of a key's name, the longest ends first.
_UNITS = {
    "_nm_per_s": "N·m/s",
    "_rad_s2": "rad/s²",
    "_rad_s": "rad/s",
    "_mnm": "mN·m",
    "_rad": "rad",
    "_mib": "MiB",
    "_nm": "N·m",
    "_us": "µs",
    "_ms": "ms",
    "_hz": "Hz",
    "_days": "d",
    "_s": "s",
    "_cycles": "cycles",
    "_counts": "counts",
}
#: Units that a key's name does not say.
_NAMED = {
    "bus.bit_rate": "bit/s",
    "bus.max_load": "share",
    "amplifier.counts_per_turn": "counts per motor turn",
    "amplifier.gear_ratio": "motor turns per joint turn",
    "encoder.counts_per_turn": "counts per joint turn",
    "stopping.least_inertia": "kg·m²",
    "stopping.least_viscous": "N·m·s/rad",
    "stopping.most_inertia": "kg·m²",
    "wiring_proof.inertia": "kg·m²",
}
_TYPES = {"null": "none", "string": "text", "object": "mapping", "number": "number", "integer": "integer"}


class ConfigKey(NamedTuple):
    """One key; all as text, an empty one where there is nothing to say. `default`: "required" where there is none."""

    key: str
    type: str
    unit: str
    default: str
    range: str
    meaning: str


def config_keys() -> list[ConfigKey]:
    """Every key of an axis configuration, in the order of the file, groups opened."""
    schema = AxisConfig.model_json_schema()
    return list(_level(schema, schema, ""))


def _level(schema: dict[str, Any], here: dict[str, Any], prefix: str) -> Iterator[ConfigKey]:
    """The keys of one level; a group is followed by its own."""
    for name, field in here["properties"].items():
        group = field.get("$ref")
        if group:
            yield from _level(schema, schema["$defs"][group.rsplit("/", 1)[1]], f"{prefix}{name}.")
            continue
        key = prefix + name
        default = "required" if name in here.get("required", []) else _default(field)
        yield ConfigKey(key, _type(field), _unit(key), default, _range(field), field.get("description", ""))


def _default(field: dict[str, Any]) -> str:
    """A default as it would stand in the file."""
    default = field.get("default", {})
    if isinstance(default, bool):
        return str(default).lower()
    return "none" if default is None else str(default)


def _type(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        return " or ".join(_type(option) for option in field["anyOf"])
    if field.get("format") == "path":
        return "path"
    kind = str(field.get("type", ""))
    return _TYPES.get(kind, kind)


def _range(field: dict[str, Any]) -> str:
    """What a value may be: the values themselves, or the ends of their range."""
    if "anyOf" in field:
        return ", ".join(filter(None, map(_range, field["anyOf"])))
    if "enum" in field:
        return ", ".join(str(value) for value in field["enum"])
    low, high = (_shown(field.get(end)) for end in ("minimum", "maximum"))
    if low and high:
        return f"{low} to {high}"
    if low or high:
        return f"at least {low}" if low else f"at most {high}"
    if "pattern" in field:
        return str(field["pattern"])
    return "not empty" if field.get("minLength") else ""


def _shown(end: float | None) -> str:
    """An end of a range, integers with all digits."""
    return "" if end is None else str(end) if isinstance(end, int) else f"{end:g}"


def _unit(key: str) -> str:
    if key in _NAMED:
        return _NAMED[key]
    return next((unit for end, unit in _UNITS.items() if key.endswith(end)), "")
