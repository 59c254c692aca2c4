"""The keys of a file or a request as tables: one for each group of keys, from the models that check them."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any, NamedTuple

from pydantic import BaseModel
from tables import code, markdown, prose

from servod.cli.gains import unit_of

#: Units that parameters of gain sets do not have.
_UNITS = {"_hz": "Hz", "_us": "µs"}
_TYPES = {"null": "none", "string": "text", "object": "mapping", "boolean": "true or false"}
#: Where a key stands at the top of its file.
TOP = ""


class Key(NamedTuple):
    """One key, all as text; an empty one where there is nothing to say."""

    name: str
    type: str
    unit: str
    default: str
    range: str
    meaning: str


class Group(NamedTuple):
    """Keys that stand together: where (`friction (lugre)`, `design.regions[]`), what the model says, and the keys."""

    path: str
    text: str
    keys: list[Key]


def groups(model: type[BaseModel], elsewhere: dict[str, str] | None = None) -> list[Group]:
    """All groups of a file's keys, outermost first; a group that stands in several places comes once.

    `elsewhere`: models whose keys another page has, each with what to say instead of them.
    """
    schema = model.model_json_schema()
    walk = _Walk(schema.get("$defs", {}), elsewhere or {})
    walk.level(schema, TOP, inspect.getdoc(model) or "")
    return walk.found


class _Walk:
    """One walk over the schema of a file."""

    def __init__(self, defined: dict[str, Any], elsewhere: dict[str, str]) -> None:
        self._defined, self._elsewhere = defined, elsewhere
        self._places: dict[str, str] = {}  # name of a definition -> where it came first
        self.found: list[Group] = []

    def level(self, here: dict[str, Any], path: str, text: str) -> None:
        """The keys of one level, then the groups in it."""
        keys: list[Key] = []
        self.found.append(Group(path, text, keys))
        inner: list[tuple[str, str]] = []
        required = here.get("required", [])
        for name, field in here.get("properties", {}).items():
            kinds = list(self._groups_in(field, _below(path, name)))
            inner += kinds
            keys.append(self._key(name, field, name in required, kinds))
        for definition, place in inner:
            if definition not in self._places and definition not in self._elsewhere:
                self._places[definition] = place
                found = self._defined[definition]
                self.level(found, place, found.get("description", ""))

    def _groups_in(self, field: dict[str, Any], place: str) -> Iterator[tuple[str, str]]:
        """Definition and place of each group that may stand under a key."""
        if name := _reference(field):
            if "properties" in self._defined[name]:
                yield name, place
            return
        if kind := field.get("discriminator"):
            for word, reference in kind["mapping"].items():
                yield reference.rsplit("/", 1)[1], f"{place} ({word})"
            return
        for option in [*field.get("anyOf", []), *field.get("allOf", [])]:
            yield from self._groups_in(option, place)
        if isinstance(field.get("items"), dict):
            yield from self._groups_in(field["items"], f"{place}[]")
        if isinstance(field.get("additionalProperties"), dict):
            yield from self._groups_in(field["additionalProperties"], f"{place}.NAME")

    def _key(self, name: str, field: dict[str, Any], required: bool, kinds: list[tuple[str, str]]) -> Key:
        kind, meaning = self._type(field), str(field.get("description", ""))
        if kinds:
            definition, place = kinds[0]
            first = self._places.get(definition, place)
            kind = (
                f"keys of `{first}`" if first != place else "list, keys below" if "[]" in place[-3:] else "keys below"
            )
            own = self._defined[definition].get("description", "").partition("\n\n")[0]
            meaning = self._elsewhere.get(definition) or meaning or ("" if len(kinds) > 1 else own)
            kind = "mapping" if definition in self._elsewhere else kind
        return Key(name, kind, _unit(name), "required" if required else _default(field), self._range(field), meaning)

    def _type(self, field: dict[str, Any]) -> str:
        if name := _reference(field):
            return self._type(self._defined[name])
        if options := field.get("anyOf"):
            return " or ".join(dict.fromkeys(self._type(option) for option in options))
        if isinstance(field.get("items"), dict):
            return f"list of {self._type(field['items'])}"
        if field.get("format"):
            return str(field["format"])
        kind = str(field.get("type", ""))
        return _TYPES.get(kind, kind)

    def _range(self, field: dict[str, Any]) -> str:
        """What a value may be: the values themselves, or the ends of their range."""
        if name := _reference(field):
            return self._range(self._defined[name])
        if options := field.get("anyOf"):
            return ", ".join(filter(None, map(self._range, options)))
        if "const" in field:
            return f"`{field['const']}`"
        if "enum" in field:
            return ", ".join(f"`{value}`" for value in field["enum"])
        if isinstance(field.get("items"), dict):
            return ", ".join(filter(None, [_count(field), self._range(field["items"])]))
        return _bounds(field)


def _unit(name: str) -> str:
    return unit_of(name) or next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")


def _below(path: str, name: str) -> str:
    """Where a key of the group at `path` stands."""
    return f"{path.partition(' ')[0]}.{name}" if path else name


def _reference(field: dict[str, Any]) -> str | None:
    """The definition that a field is of, if it is of one."""
    whole = field.get("$ref")
    return whole.rsplit("/", 1)[1] if whole else None


def _count(field: dict[str, Any]) -> str:
    least, most = field.get("minItems"), field.get("maxItems")
    if least and most:
        return f"{least} to {most} entries"
    return f"at least {least} entries" if least else f"at most {most} entries" if most else ""


def _bounds(field: dict[str, Any]) -> str:
    low = [f"{sign} {field[key]:g}" for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">")) if key in field]
    high = [f"{sign} {field[key]:g}" for key, sign in (("maximum", "≤"), ("exclusiveMaximum", "<")) if key in field]
    if "pattern" in field:
        return f"`{field['pattern']}`"
    if "maxLength" in field:
        return f"{field.get('minLength', 0)} to {field['maxLength']} characters"
    return ", ".join(low + high)


def _default(field: dict[str, Any]) -> str:
    default = field.get("default", "")
    if isinstance(default, bool):
        return str(default).lower()
    return "none" if default is None else str(default)


def with_meanings(found: list[Group], more: dict[str, str]) -> list[Group]:
    """The same with `more` in place of what the models say nothing of: `path.key` -> meaning."""
    return [
        group._replace(
            keys=[k if k.meaning else k._replace(meaning=more.get(address(group, k), "")) for k in group.keys]
        )
        for group in found
    ]


def address(group: Group, key: Key) -> str:
    """Where a key stands in its file, as one text."""
    return f"{group.path}.{key.name}" if group.path else key.name


def text(found: list[Group], units: bool, top: str) -> str:
    """All groups of a file as Markdown: `top` is the heading of the outermost one. `units`: a column of its own."""
    parts = []
    for group in found:
        parts.append(f"## `{group.path}`" if group.path else f"## {top}")
        if group.text and group.path:
            parts.append(prose(group.text))
        if group.keys:
            parts.append(table(group.keys, units))
    return "\n\n".join(parts)


def table(keys: list[Key], units: bool) -> str:
    """One group's table."""
    header = ["Key", "Type", *(["Unit"] if units else []), "Default", "Range", "Meaning"]
    rows = [
        [f"`{k.name}`", k.type, *([k.unit] if units else []), code(k.default), k.range, prose(k.meaning)] for k in keys
    ]
    return markdown(header, rows)
