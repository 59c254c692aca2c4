"""The tables of docs/reference that files, recordings and the control socket are described by, from their models."""

from __future__ import annotations

import enum
from functools import cache
from pathlib import Path

import schema
import yaml
from tables import markdown, prose

from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.formats.protocol import MAX_ANSWER_BYTES, MAX_LINE_BYTES, PIECE_SAMPLES, READING, Verb
from servod.formats.recording.record import FIELDS
from servod.lab.recordings.columns import COMMANDS, REQUIRED, Quantity, dimension_of, spellings, units_of
from servod.runtime.daemon.arguments import arguments_of
from servod.runtime.daemon.control_server import MAX_CLIENTS, MAX_CLIENTS_OF_A_PROCESS, STOPPING
from servod.runtime.fieldbus.devices import REASON_TEXT, DriveState, Goal
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import REFUSAL_TEXT, Refusal

_HERE = Path(__file__).parent
_TYPES = {"d": "float64", "q": "int64"}
#: Pages that have the keys of a model instead of the one that it stands in.
_ELSEWHERE = {"AxisModel": "what it was designed for, with the keys of an axis model"}


@cache
def meanings() -> dict[str, dict[str, str]]:
    """What the models say nothing of, by file and key."""
    found: dict[str, dict[str, str]] = yaml.safe_load((_HERE / "meanings.yaml").read_text())
    return found


def axis_model_groups() -> list[schema.Group]:
    """The keys of an axis model."""
    return schema.with_meanings(schema.groups(AxisModel), meanings()["axis_model"])


def gain_set_groups() -> list[schema.Group]:
    """The keys of a gain set."""
    return schema.with_meanings(schema.groups(GainSet, _ELSEWHERE), meanings()["gain_set"])


def axis_model() -> str:
    """The groups of keys of an axis model."""
    return schema.text(axis_model_groups(), units=False, top="The axis")


def gain_set() -> str:
    """The groups of keys of a gain set."""
    return schema.text(gain_set_groups(), units=True, top="The set")


def virtual_axis() -> str:
    """The keys of a settings file of the virtual axis."""
    (found,) = schema.groups(VirtualAxisSettings)
    return schema.table(found.keys, units=True)


def columns() -> str:
    """The columns that a recording of another machine may have."""
    rows = [
        [
            q.name.lower().replace("_", " "),
            *(f"`{name}`" for name in q.value),
            "yes" if q in REQUIRED else "one of these" if q in COMMANDS else "",
            _units(q),
        ]
        for q in Quantity
    ]
    return markdown(["Quantity", "Rotary axis", "Linear axis", "Needed", "Units that a map may name"], rows)


def unit_spellings() -> str:
    """Other ways to write a unit in a map."""
    rows = [[f"`{unit}`", ", ".join(f"`{name}`" for name in names)] for unit, names in spellings().items()]
    return markdown(["Unit", "May also be written"], rows)


def _units(quantity: Quantity) -> str:
    """Units of the rotary column, and those of the linear one where they differ."""
    told = dict.fromkeys(", ".join(f"`{unit}`" for unit in units_of(dimension_of(name))) for name in quantity.value)
    return "; ".join(told)


def record() -> str:
    """The fields of a cycle record."""
    rows = [[f"`{f.name}`", _TYPES[f.kind], f.unit, prose(f.text)] for f in FIELDS]
    return markdown(["Field", "Type", "Unit", "Meaning"], rows)


def record_numbers() -> str:
    """The names behind the numbers of a record."""
    kinds: dict[str, type[enum.IntEnum]] = {
        "axis_state": AxisState,
        "drive_state": DriveState,
        "goal": Goal,
    }
    rows = [[f"`{field}`", str(int(member)), f"`{member.name}`"] for field, kind in kinds.items() for member in kind]
    rows += [["`reasons`", str(int(bit)), f"`{bit.name}`: {text}"] for bit, text in REASON_TEXT.items()]
    rows += [["`command_result`", "below 0", "the request to enable is to be confirmed with this number"]]
    rows += [["`command_result`", str(int(r)), f"`{r.name}`: {REFUSAL_TEXT.get(r, 'done')}"] for r in Refusal]
    return markdown(["Field", "Number", "Meaning"], rows)


def _right(verb: Verb) -> str:
    if verb in READING:
        return "Everybody may ask it."
    return "Everybody may ask it, whoever commands." if verb in STOPPING else "Takes the lease."


@cache
def documents() -> dict[str, dict[str, dict[str, str]]]:
    """What is answered and printed as JSON, by command and key."""
    found: dict[str, dict[str, dict[str, str]]] = yaml.safe_load((_HERE / "documents.yaml").read_text())
    return found


def protocol() -> str:
    """Every verb, the right that it needs, its arguments and what it answers."""
    parts = [markdown(["Bound", "Value"], _bounds())]
    for verb in Verb:
        told = documents()["protocol"][verb.value]
        parts.append(f"## `{verb.value}`\n\n{told['does']} {_right(verb)}\n\nAnswer: {told['answer']}.")
        arguments = [group for group in schema.groups(arguments_of(verb)) if group.keys]
        parts += [schema.table(group.keys, units=True) for group in arguments]
        if told.get("arguments"):
            parts.append(told["arguments"])
    return "\n\n".join(parts)


def _bounds() -> list[list[str]]:
    return [
        ["a request, bytes with its line end", str(MAX_LINE_BYTES)],
        ["an answer that the shipped client takes, bytes", str(MAX_ANSWER_BYTES)],
        ["samples in one request", str(PIECE_SAMPLES)],
        ["clients", f"{MAX_CLIENTS}, {MAX_CLIENTS_OF_A_PROCESS} of one process"],
    ]


def json_documents() -> str:
    """The documents that `--json` prints, a table for each verb; verbs that print the same share one."""
    shared: dict[int, list[str]] = {}
    for name, keys in documents().items():
        if name != "protocol":
            shared.setdefault(id(keys), []).append(name)
    parts = []
    for names in shared.values():
        parts.append("\n\n".join(f"## {name}" if name != "error" else "## Every error" for name in names))
        rows = [[f"`{key}`" if key != "**" else "all others", text] for key, text in documents()[names[0]].items()]
        parts.append(markdown(["Key", "Meaning"], rows))
    return "\n\n".join(parts)
