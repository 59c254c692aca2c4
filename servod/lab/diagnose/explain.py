"""What `servoctl explain` prints of an effect, drawn from its file and from its group of keys in the axis model.

Stands beside the effects; nothing here is used in a diagnosis.
"""

from __future__ import annotations

from typing import Any, get_args

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from servod.formats.model.axis_model import AxisModel, LugreFriction
from servod.formats.model.drive import DriveLaw
from servod.lab.diagnose.effects import effect, effects
from servod.lab.diagnose.effects.effect import Effect

#: Signs of bounds in text.
_SIGNS = {Ge: (">=", "ge"), Gt: (">", "gt"), Le: ("<=", "le"), Lt: ("<", "lt")}


def list_effects() -> dict[str, str]:
    """Name -> statement of every effect."""
    return {found.name: found.statement for found in effects()}


def explain_effect(name: str) -> dict[str, Any]:
    """Equation, source, keys, signature and separating experiment of the effect `name`."""
    found = effect(name)
    return {
        "effect": found.name,
        "statement": found.statement,
        "equation": found.equation,
        "source": found.source,
        "shows": found.shows,
        "confused_with": list(found.confused),
        "experiment": found.experiment,
        "keys": [
            *_keys(found),
            *(_friction_key(key) for key in found.friction_keys),
            *(_key(f"drive.{key}", DriveLaw.model_fields[key]) for key in found.drive_keys),
        ],
    }


def _keys(found: Effect) -> list[dict[str, str]]:
    """Keys of the effect's group of the axis model, or the plain key itself."""
    if found.group is None:
        return [_key(found.name, AxisModel.model_fields[found.name])] if found.name in AxisModel.model_fields else []
    return _fields(found.name, found.group)


def _friction_key(key: str) -> dict[str, str]:
    return _key(f"friction.{key}", LugreFriction.model_fields[key])


def _fields(path: str, model: type[BaseModel]) -> list[dict[str, str]]:
    found = []
    for name, field in model.model_fields.items():
        inner = _model_of(field.annotation)
        found += [_key(f"{path}.{name}", field)] if inner is None else _fields(f"{path}.{name}[]", inner)
    return found


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """The model within an annotation such as `Group | None` or `tuple[Harmonic, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = [_model_of(part) for part in get_args(annotation)]
    return next((model for model in inner if model is not None), None)


def _key(path: str, field: FieldInfo) -> dict[str, str]:
    bounds = []
    for part in _metadata(field):
        for kind, (sign, attribute) in _SIGNS.items():
            if isinstance(part, kind):
                bounds.append(f"{sign} {getattr(part, attribute):g}")
    default = "" if field.is_required() or field.default is None else f"default {field.default}"
    text = ", ".join(part for part in (*bounds, default) if part)
    return {"key": path, "meaning": field.description or "", "range": text or "any number"}


def _metadata(field: FieldInfo) -> list[Any]:
    """Bounds of the field itself and of the annotated types in its annotation."""
    found = list(field.metadata)
    for part in get_args(field.annotation):
        for entry in getattr(part, "__metadata__", ()):
            found += entry.metadata if isinstance(entry, FieldInfo) else [entry]
    return found
