"""The reference has every key, option, fault, exit code and field, and says something of each."""

from __future__ import annotations

import re
from collections.abc import Iterator
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict

import command_line
import pytest
import readme
import reference
import safety_trace
import schema

from servod.cli.app import _CODES, INTERRUPTED, command
from servod.cli.config import config_keys
from servod.common.errors import AnswerIsNo, BadInput, ServodError, Unreachable
from servod.common.faults import FaultCode
from servod.drivers.quirks import QUIRKS
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.protocol import Verb
from servod.formats.recording.record import FIELDS
from servod.runtime.daemon.status import Status
from servod.runtime.loop.wiring.findings import WiringReport, wiring_document
from tests import documents

VERBS = list(command_line.verbs())
GROUPS = {"axis_model": reference.axis_model_groups(), "gain_set": reference.gain_set_groups()}


def page(name: str) -> str:
    return (readme.DOCS / f"reference/{name}.md").read_text()


def first_cells(text: str) -> set[str]:
    """The first cell of each row of a page's tables, without its backquotes."""
    return {cell.strip("`") for cell in re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)}


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("configuration", {key.key for key in config_keys()}),
        ("faults", {code.name for code in FaultCode}),
        ("drives", {name for name, row in QUIRKS.items() if row.deviations}),
        ("recording", {field.name for field in FIELDS}),
        ("cli", set(VirtualAxisSettings.model_fields)),
        ("exit-codes", {str(kind.exit_code) for kind in (ServodError, AnswerIsNo, BadInput, Unreachable)}),
        ("exit-codes", {"0", str(INTERRUPTED), "143"}),
        ("exit-codes", {code for _, code in _CODES} | {"internal"}),
    ],
)
def test_every_one_stands_in_its_table(name: str, wanted: set[str]) -> None:
    assert wanted and wanted - first_cells(page(name)) == set()


def options(found: Any, words: str) -> Iterator[tuple[str, str]]:
    """Command and option (or argument) of all that can be typed, as click has them."""
    for param in found.params:
        names = [*param.opts, *param.secondary_opts] if param.param_type_name == "option" else [param.name]
        yield from ((words, name) for name in names)
    for name, inner in getattr(found, "commands", {}).items():
        if not inner.hidden:
            yield from options(inner, f"{words} {name}")


def test_every_verb_and_option_stands_in_the_command_line() -> None:
    sections = dict(re.findall(r"^### (servoctl [\w -]+)\n(.*?)(?=^##)", page("cli"), re.DOTALL | re.MULTILINE))
    typed = [(words, name) for words, name in options(command(), "servoctl") if words != "servoctl"]
    assert {words for words, _ in typed} <= set(sections)
    wrong = [(words, name) for words, name in typed if name.startswith("-") and not _has(sections[words], name)]
    assert typed and wrong == []
    arguments = {words: sum(not name.startswith("-") for w, name in typed if w == words) for words, _ in typed}
    rows = {words: len(re.findall(r"^\| `(?!-)", sections[words], re.MULTILINE)) for words in arguments}
    assert rows == arguments


def _has(section: str, option: str) -> bool:
    return any(option in re.split(r"[ ,/]+", row) for row in first_cells(section))


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb.rows], ids=lambda verb: verb.words)
def test_every_option_says_what_it_does(verb: command_line.Verb) -> None:
    assert verb.text and [row.name for row in verb.rows if not row.meaning] == []


def test_every_setting_of_the_virtual_axis_has_a_meaning() -> None:
    silent = [key.name for group in schema.groups(VirtualAxisSettings) for key in group.keys if not key.meaning]
    assert silent == []


@pytest.mark.parametrize("name", GROUPS)
def test_every_key_of_a_file_has_a_meaning(name: str) -> None:
    every = {schema.address(group, key): key.meaning for group in GROUPS[name] for key in group.keys}
    assert every and [key for key, meaning in every.items() if not meaning] == []


@pytest.mark.parametrize("name", GROUPS)
def test_a_meaning_stands_once(name: str) -> None:
    """What a model says is not said again beside it, nor anything of a key that no model has."""
    models = {"axis_model": schema.groups(reference.AxisModel), "gain_set": schema.groups(reference.GainSet)}
    silent = {schema.address(group, key) for group in models[name] for key in group.keys if not key.meaning}
    assert set(reference.meanings()[name]) - silent == set()


def test_every_verb_of_the_protocol_stands_in_its_page() -> None:
    assert set(reference.documents()["protocol"]) == {verb.value for verb in Verb}
    for verb in Verb:
        keys = {key.name for group in schema.groups(reference.arguments_of(verb)) for key in group.keys}
        section = re.search(rf"^## `{verb.value}`\n(.*?)(?=^## |\Z)", page("protocol"), re.DOTALL | re.MULTILINE)
        assert section and keys - first_cells(section[1]) == set(), verb


def test_every_verb_with_json_says_what_it_prints() -> None:
    with_json = {verb.words for verb in VERBS if any(row.name == "--json" for row in verb.rows)}
    told = {name for name, keys in documents.documents().items() if name.startswith("servoctl") and keys}
    assert {name.partition(" --")[0] for name in told} == with_json


def fields(kind: Any) -> Iterator[documents.Place]:
    """The places of all values of a typed document."""
    for name, hint in get_type_hints(kind).items():
        parts = get_args(hint) if isinstance(hint, UnionType) else ()  # a document, or None
        inner = next(filter(is_typeddict, parts), hint)
        if is_typeddict(inner):
            yield from ((name, *place) for place in fields(inner))
        elif get_origin(inner) is list and is_typeddict(get_args(inner)[0]):
            yield from ((name, "[]", *place) for place in fields(get_args(inner)[0]))
        else:
            yield (name,)


def test_the_status_document_is_told_as_it_is_typed() -> None:
    wiring = wiring_document(WiringReport(*([0] * len(WiringReport._fields))))
    typed = {*fields(Status), *(("wiring", "last", key) for key in wiring)}
    assert set(documents.places("servoctl status")) == typed


# --- the watch over what is printed -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "document", "missing"),
    [
        ("servoctl record stop", {"path": "", "rows": 1}, ["rows"]),
        ("servoctl scan", {"nodes": [{"node_id": 1, "lss": None}, {"speed": 1}]}, ["nodes.[].speed"]),
        ("servoctl scan", {"nodes": []}, []),
        ("servoctl diagnose", {"minor": {}, "fit": {"windows": {"0.25": {"unit": "rad"}}}}, []),
        ("servoctl diagnose", {"fit": {"windows": {"0.25": {"units": "rad"}}}}, ["fit.windows.0.25.units"]),
        ("servoctl status", {"wiring": {"last": None}}, []),
        ("servoctl status", {"wiring": 1}, ["wiring"]),
        ("servoctl scan", {"error": {"code": "usage", "line": 1}}, ["error.line"]),
        ("servoctl faults --codes", [{"code": "A", "colour": "red"}], ["[].colour"]),
        ("servoctl dance", {"steps": 1}, ["steps"]),
    ],
)
def test_a_key_that_the_reference_does_not_have_is_seen(command: str, document: Any, missing: list[str]) -> None:
    assert documents.undescribed(command, document) == missing


@pytest.mark.parametrize(
    ("words", "command"),
    [
        (["gains", "list", "--json"], "servoctl gains list"),
        (["faults", "--last", "3", "--codes"], "servoctl faults --codes"),
        (["qualify", "faults", "--only", "x"], "servoctl qualify faults"),
        (["demo", "--fast", "--diagnose"], "servoctl demo --diagnose"),
        (["verify", "gains.yaml", "--json"], "servoctl verify"),
        (["record", "export", "x.mcap"], "servoctl record export"),
    ],
)
def test_the_command_of_a_command_line(words: list[str], command: str) -> None:
    assert documents.command_of(words) == command


def test_each_requirement_of_safety_is_shown_by_what_exists() -> None:
    assert list(safety_trace.complaints()) == []
    assert safety_trace.missing("scenario killed/nobody") and safety_trace.missing("cycle none")
    assert safety_trace.missing("test tests/tools/test_reference.py::test_none") and safety_trace.missing(
        "test x.py::y"
    )


def test_each_hazard_of_the_trace_is_one_of_the_safety_page_and_has_a_requirement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known = safety_trace.hazards()
    assert list(known) == [f"H{n}" for n in range(1, len(known) + 1)] and len(known) >= 10
    one, *others = every = safety_trace.requirements()

    def told(changed: list[safety_trace.Requirement]) -> list[str]:
        monkeypatch.setattr(safety_trace, "requirements", lambda: changed)
        return [line for line in safety_trace.complaints() if "hazard" in line]

    assert f"{one.id}: docs/safety.md has no hazard H99" in told([one._replace(hazards=["H99"]), *others])
    for hazard in known:
        left = [other for other in every if hazard not in other.hazards]
        assert f"no requirement answers the hazard {hazard}" in told(left)
