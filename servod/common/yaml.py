"""Reads YAML as version 1.2 means it, and checks it against a pydantic model with errors that people can act on.

PyYAML follows YAML 1.1: it reads `1e-3` as a string and `on` as true. Every file that servod reads (configuration,
gain sets, axis models, column maps) comes through here, so that a number is a number and an unknown key is an error.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from servod.common.errors import BadInput
from servod.common.files import read_text

try:
    from yaml import CSafeLoader
except ImportError:  # PyYAML was built without libyaml
    from yaml import SafeLoader as CSafeLoader  # type: ignore[assignment]

__all__ = ["Dumper", "Strict", "load_model", "parse_yaml", "read_text", "validate"]

_FLOAT = re.compile(
    r"^[-+]?(?:(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$"
)
_INT = re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$")
_BOOL = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_NULL = re.compile(r"^(?:~|null|Null|NULL|)$")
#: What libyaml takes in places where PyYAML refuses it.
_UNEVEN = re.compile(r"[!?]|[|>].*#")
#: Digits of the longest number; no float has more that count.
_LONGEST_NUMBER = 400


#: Longest text that is taken for one of servod's YAML files; the longest that it writes itself have 100 KiB.
_MOST_CHARACTERS = 1024 * 1024
#: Most values in a document, each alias counted with all that it stands for: a few lines of aliases mean billions.
_MOST_VALUES = 100_000
#: Most brackets within brackets.
_DEEPEST = 50


class _Core(yaml.composer.Composer, yaml.constructor.SafeConstructor, yaml.resolver.Resolver):
    """What a document means: the core schema of YAML 1.2 (section 10.3) alone, no key twice, and of bounded size."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's own class attribute, replaced as a whole)
    yaml_constructors: ClassVar[dict[Any, Any]] = {
        tag: constructor
        for tag, constructor in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in ("null", "bool", "int", "float", "str", "seq", "map")
    }

    def __init__(self) -> None:
        for base in _Core.__bases__:
            base.__init__(self)  # type: ignore[misc]
        self._depth = self._nodes = 0
        self._values: dict[int, int] = {}  # of each finished node, by its identity

    def _mark(self) -> yaml.Mark:
        mark: yaml.Mark = self.peek_event().start_mark  # type: ignore[attr-defined]
        return mark

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """One node, counted; an alias of a node that is not finished stands within itself."""
        if self.check_event(yaml.AliasEvent):  # type: ignore[attr-defined]
            mark = self._mark()
            node = super().compose_node(parent, index)
            if id(node) not in self._values:
                raise yaml.composer.ComposerError(None, None, "an alias within what it stands for", mark)
            return node
        mark = self._mark()
        self._depth, self._nodes = self._depth + 1, self._nodes + 1
        if self._depth > _DEEPEST:
            raise yaml.composer.ComposerError(None, None, f"more than {_DEEPEST} brackets within each other", mark)
        node = super().compose_node(parent, index) if self._nodes <= _MOST_VALUES else None
        self._depth -= 1
        self._values[id(node)] = count = 1 + sum(self._values[id(part)] for part in _parts(node))
        if max(count, self._nodes) > _MOST_VALUES:
            raise yaml.composer.ComposerError(None, None, f"more than {_MOST_VALUES} values", mark)
        return node

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


class _Loader(_Core, yaml.SafeLoader):
    """PyYAML's own parser."""

    def __init__(self, text: str) -> None:
        yaml.SafeLoader.__init__(self, text)
        _Core.__init__(self)


class _SwiftLoader(_Core, CSafeLoader):
    """libyaml's, where PyYAML has it: a certified gain set takes it a fifth of the time."""

    def __init__(self, text: str) -> None:
        CSafeLoader.__init__(self, text)
        _Core.__init__(self)


def _parts(node: yaml.Node | None) -> Iterator[yaml.Node]:
    """What stands directly in a node."""
    if isinstance(node, yaml.SequenceNode):
        yield from node.value
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield from (key, value)


def _scalar(loader: yaml.SafeLoader, node: yaml.Node, pattern: re.Pattern[str], what: str) -> str:
    """Text of a scalar of the core schema; a tag may stand before any text, and before what is no scalar."""
    text = loader.construct_scalar(node) if isinstance(node, yaml.ScalarNode) else ""
    if not pattern.match(text) or len(text) > _LONGEST_NUMBER:
        raise yaml.constructor.ConstructorError(None, None, f"{text[:40]!r}, which is no {what}", node.start_mark)
    return str(text)


def _construct_bool(loader: yaml.SafeLoader, node: yaml.Node) -> bool:
    return _scalar(loader, node, _BOOL, "boolean").lower() == "true"


def _construct_int(loader: yaml.SafeLoader, node: yaml.Node) -> int:
    text = _scalar(loader, node, _INT, "integer")
    base = {"0x": 16, "0o": 8}.get(text[:2].lower(), 10)
    return int(text[2:] if base != 10 else text, base)


def _construct_float(loader: yaml.SafeLoader, node: yaml.Node) -> float:
    text = _scalar(loader, node, _FLOAT, "number").lower()
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


for _tag, _pattern, _first in (
    ("null", _NULL, ["~", "n", "N", ""]),
    ("bool", _BOOL, list("tTfF")),
    ("int", _INT, list("-+0123456789")),
    ("float", _FLOAT, list("-+.0123456789")),
):
    _Core.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, _first)
_Core.add_constructor("tag:yaml.org,2002:bool", _construct_bool)
_Core.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Core.add_constructor("tag:yaml.org,2002:float", _construct_float)


class Dumper(yaml.SafeDumper):
    """Writes YAML that this module reads back: quotes the strings that YAML 1.2 would take for something else."""

    yaml_implicit_resolvers = _Core.yaml_implicit_resolvers


class Strict(BaseModel):
    """Base of every file model: unknown keys are errors, values are frozen, numbers must be finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


#: What PyYAML calls a part of the text that stands where none may, in words of the file.
_TOKENS = {
    "<scalar>": "a text where none may stand",
    "<stream end>": "the end of the file, where more must come",
    "<block mapping start>": "keys that are indented otherwise than those before",
    "<block sequence start>": "a list that is indented otherwise than what is before",
    "<block end>": "the end of what is indented",
    "<document start>": "the start of another document",
    "<document end>": "the end of the document",
    "<directive>": "a directive (%)",
    "<alias>": "an alias (*) where none may stand",
    "<anchor>": "an anchor (&) where none may stand",
    "<tag>": "a tag (!) where none may stand",
    "?": "a key where none may stand",
}


def parse_yaml(text: str, where: str) -> Any:
    """Parse one YAML 1.2 document; raises BadInput naming `where` and the line."""
    if len(text) > _MOST_CHARACTERS:
        raise BadInput(where, f"{len(text)} characters", f"a YAML file of at most {_MOST_CHARACTERS} characters")
    try:
        return _load(text)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        problem = (error.problem or "broken YAML").replace("but got ", "but found ")
        found = problem.rpartition("but found ")[2].removeprefix("found ")
        found = _TOKENS.get(found.strip("'"), found)
        raise BadInput(f"{where}: line {line}", found, "a YAML 1.2 mapping") from None
    except (yaml.YAMLError, ValueError) as error:
        raise BadInput(where, (str(error).splitlines() or ["broken YAML"])[0], "a YAML 1.2 mapping") from None


def _load(text: str) -> Any:
    """Its value. What is wrong PyYAML says in all cases, and it judges all texts in which libyaml takes more."""
    if text.replace("\n", "").isprintable() and not _UNEVEN.search(text):
        with contextlib.suppress(yaml.YAMLError, ValueError):
            return yaml.load(text, Loader=_SwiftLoader)  # noqa: S506  (a safe one)
    return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)


def load_model(path: str | Path, model: type[M]) -> M:
    """Read the YAML file at `path` and validate it as `model`; raises BadInput (file, key, found, allowed)."""
    return validate(parse_yaml(read_text(path), str(path)), model, str(path))


def validate(data: Any, model: type[M], where: str) -> M:
    """Validate plain data as `model`; the first problem becomes one BadInput line.

    Strictly: neither `true` nor "2.5" in quotes is a number. JSON is the way to have that and still read a path or an
    enumeration from its text, as pydantic's strict mode does not from Python objects.
    """
    if not isinstance(data, dict):
        raise BadInput(where, f"{plain_name(data)} at the top", "a mapping of keys")
    try:
        return model.model_validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as error:
        raise _bad_input(error, model, data, where) from None
    except RecursionError:
        raise BadInput(where, "brackets nested without end", "a mapping of keys") from None


def plain_name(value: Any) -> str:
    """What kind of value stands in a file, in words of the file and not of Python."""
    if isinstance(value, bool):
        return str(value).lower()
    known = {dict: "a mapping", list: "a list", str: "text", int: "a number", float: "a number"}
    return known.get(type(value), "nothing")


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
    if first["type"] == "json_invalid":
        return BadInput(where, first["ctx"]["error"], "text of whole Unicode characters")
    message = _ALLOWED.get(first["type"]) or _PYDANTIC_WORDS.sub("", first["msg"])
    return BadInput(f"{where}: {key}", _found(first["input"], message), message)


_PYDANTIC_WORDS = re.compile(
    r"^Value error, |^Input should be |^(?:String|List|Dictionary) should have | after validation"
)
#: What to say of pydantic's kinds of mistakes whose own words speak of Python.
_ALLOWED = {
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "a mapping of keys"),
    **{"list_type": "a list", "string_type": "text", "bool_type": "true or false", "path_type": "a path"},
}


def _found(value: Any, message: str) -> str:
    """What stood in the file, at most 80 characters; of a whole mapping only the keys that `message` speaks of."""
    if isinstance(value, dict):
        named = [f"{key}: {item}" for key, item in value.items() if str(key) in message]
        if named:
            return ", ".join(named)[:80]
    return plain_name(value) if isinstance(value, bool | dict | list | None) else repr(value)[:80]


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
