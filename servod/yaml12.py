"""Reads YAML as version 1.2 means it, and checks it against a pydantic model with errors that people can act on.

PyYAML follows YAML 1.1: it reads `1e-3` as a string and `on` as true. Every file that servod reads (configuration,
gain sets, axis models, column maps) comes through here, so that a number is a number and an unknown key is an error.
"""

from __future__ import annotations

import difflib
import json
import re
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from servod.errors import BadInput

_FLOAT = re.compile(
    r"^[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"
)
_INT = re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$")
_BOOL = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_NULL = re.compile(r"^(?:~|null|Null|NULL|)$")


class _Loader(yaml.SafeLoader):
    """SafeLoader with the core schema of YAML 1.2 (section 10.3) and without duplicate keys."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's own class attribute, replaced as a whole)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str | int | float | bool | None):
                raise yaml.constructor.ConstructorError(None, None, "a key that is no plain word", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} twice", key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)


def _construct_int(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    base = {"0x": 16, "0o": 8}.get(text[:2].lower(), 10)
    return int(text[2:] if base != 10 else text, base)


def _construct_float(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node).lower()
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


for _tag, _pattern, _first in (
    ("null", _NULL, ["~", "n", "N", ""]),
    ("bool", _BOOL, list("tTfF")),
    ("int", _INT, list("-+0123456789")),
    ("float", _FLOAT, list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, _first)
_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)


class Dumper(yaml.SafeDumper):
    """Writes YAML that this module reads back: quotes the strings that YAML 1.2 would take for something else."""

    yaml_implicit_resolvers = _Loader.yaml_implicit_resolvers


class Strict(BaseModel):
    """Base of every file model: unknown keys are errors, values are frozen, numbers must be finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


def parse_yaml(text: str, where: str) -> Any:
    """Parse one YAML 1.2 document; raises BadInput naming `where` and the line."""
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        raise BadInput(f"{where}: line {line}", error.problem or "broken YAML", "a YAML 1.2 mapping") from None
    except (yaml.YAMLError, ValueError) as error:
        raise BadInput(where, str(error).splitlines()[0], "a YAML 1.2 mapping") from None
    except RecursionError:
        raise BadInput(where, "brackets nested without end", "a YAML 1.2 mapping") from None


def read_text(path: str | Path) -> str:
    """The file's text; raises BadInput when it is missing, unreadable or not UTF-8."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise BadInput(str(path), "bytes that are not UTF-8", "a text file") from None
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a readable file") from None


def load_model(path: str | Path, model: type[M]) -> M:
    """Read the YAML file at `path` and validate it as `model`; raises BadInput (file, key, found, allowed)."""
    return validate(parse_yaml(read_text(path), str(path)), model, str(path))


def validate(data: Any, model: type[M], where: str) -> M:
    """Validate plain data as `model`; the first problem becomes one BadInput line.

    Strictly: neither `true` nor "2.5" in quotes is a number. JSON is the way to have that and still read a path or an
    enumeration from its text, as pydantic's strict mode does not from Python objects.
    """
    if not isinstance(data, dict):
        raise BadInput(where, f"{type(data).__name__} at the top", "a mapping of keys")
    try:
        return model.model_validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        raise _bad_input(error, model, data, where) from None


def _bad_input(error: ValidationError, model: type[BaseModel], data: Any, where: str) -> BadInput:
    """Choose the most telling problem: an unknown key explains a missing one, so it goes first."""
    problems = error.errors(include_url=False)
    first = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    key = ".".join(_file_path(first["loc"], data, first["type"] in ("missing", "extra_forbidden"))) or "(top)"
    if first["type"].startswith("union_tag"):
        tag = str(first["ctx"]["discriminator"]).strip("'")
        allowed = first["ctx"].get("expected_tags", "a value; this key is required")
        return BadInput(f"{where}: {key}.{tag}", repr(first["input"].get(tag, "nothing")), allowed)
    if first["type"] == "extra_forbidden":
        return BadInput(f"{where}: {key}", "an unknown key", _known_keys(model, first["loc"]))
    if first["type"] == "missing":
        return BadInput(f"{where}: {key}", "nothing", "a value; this key is required")
    message = first["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return BadInput(f"{where}: {key}", _found(first["input"], message), message)


def _found(value: Any, message: str) -> str:
    """What stood in the file, at most 80 characters; of a whole mapping only the keys that `message` speaks of."""
    if isinstance(value, dict):
        named = [f"{key}: {item}" for key, item in value.items() if str(key) in message]
        if named:
            return ", ".join(named)[:80]
    return repr(value)[:80]


def _file_path(loc: tuple[int | str, ...], data: Any, ends_in_key: bool) -> list[str]:
    """`loc` as a path in the file: without the tags that pydantic adds where a discriminated union was entered.

    `ends_in_key`: the last part is a key although the file does not have it, or should not.
    """
    path = []
    for i, part in enumerate(loc):
        here = (isinstance(data, dict) and part in data) or (isinstance(data, list) and isinstance(part, int))
        if here or (ends_in_key and i == len(loc) - 1):
            path.append(str(part))
        if here:
            data = data[part]
    return path


def _known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    fields = _fields_at(model, loc[:-1])
    near = difflib.get_close_matches(str(loc[-1]), fields, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return (", ".join(fields) or "none here") + hint


def _fields_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Field names of the (nested) model that stands at `loc`; empty when it is not a plain nested model."""
    schema = model.model_json_schema()
    here: Any = schema
    for part in loc:
        here = _resolve(here, schema, part)
        if here is None:
            return []
    return list(_deref(here, schema).get("properties", {}))


def _deref(here: Any, schema: dict[str, Any]) -> dict[str, Any]:
    for option in [here, *here.get("anyOf", []), *here.get("oneOf", []), *here.get("allOf", [])]:
        if "$ref" in option:
            return schema["$defs"][option["$ref"].rsplit("/", 1)[1]]  # type: ignore[no-any-return]
    return here  # type: ignore[no-any-return]


def _resolve(here: Any, schema: dict[str, Any], part: int | str) -> Any:
    """One step down a JSON schema; a discriminated union is entered by the tag that pydantic puts into `loc`."""
    here = _deref(here, schema) if "oneOf" not in here else here
    if isinstance(part, int):
        return here.get("items")
    for option in here.get("oneOf", []):
        if option.get("$ref", "").endswith(f"/{part}"):
            return option
    mapping = here.get("discriminator", {}).get("mapping", {})
    if part in mapping:
        return {"$ref": mapping[part]}
    return here.get("properties", {}).get(part)
