"""YAML 1.2 as every file is read: numbers are numbers, words are words, and what is neither is one line."""

import string
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from servod.common import yaml as ours
from servod.common.errors import BadInput
from servod.common.yaml import parse_yaml, validate
from servod.formats.config import AxisConfig

LIMITS = (
    "limits: {torque_nm: 0.3, torque_rate_nm_per_s: 3e2, speed_rad_s: 20, position_min_rad: -3, position_max_rad: 3, "
    "following_error_rad: 0.5, encoder_mismatch_rad: 5e-2}\ngains: {initial: a.yaml}\n"
)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("0x10", 16),
        ("0o17", 15),
        ("010", 10),
        ("on", "on"),
        ("yes", "yes"),
        ("true", True),
        ("~", None),
    ],
)
def test_scalars_are_of_version_1_2(text, value):
    assert parse_yaml(f"a: {text}", "f.yaml") == {"a": value}


@pytest.mark.parametrize(
    "text",
    ["a: 1\na: 2", "? [a, b]\n: 1", "a: [", "\ta: 1", "a: " + "[" * 5000, "- 1", "a: !!python/object:os.system x"],
    ids=["twice", "list as key", "open", "tab", "nested", "list", "object"],
)
def test_broken_text_is_one_line_with_the_file(text):
    with pytest.raises(BadInput) as caught:
        validate(parse_yaml(text, "f.yaml"), AxisConfig, "f.yaml")
    assert str(caught.value).startswith("f.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["true", '"0.3"', "[0.3]", ".nan", ".inf", "on"])
def test_only_finite_numbers_are_numbers(value):
    with pytest.raises(BadInput, match=r"f\.yaml: limits\.torque_nm"):
        validate(parse_yaml(LIMITS.replace("torque_nm: 0.3", f"torque_nm: {value}"), "f.yaml"), AxisConfig, "f.yaml")


def test_a_good_file_is_taken_with_whole_numbers_for_reals():
    config = validate(parse_yaml(LIMITS, "f.yaml"), AxisConfig, "f.yaml")
    assert (config.limits.speed_rad_s, config.limits.encoder_mismatch_rad) == (20.0, 0.05)


SHIPPED = Path(__file__).parents[2] / "gains"
WORDS = st.sampled_from(
    [*string.printable, "\ufeff", "\u2028", "é", ": ", "- ", "\n  ", "|\n  ", "&a ", "*a", "1e3", "'#"]
)


def outcome(load: Callable[[str], Any], text: str) -> str:
    try:
        return repr(load(text))
    except (yaml.YAMLError, ValueError) as error:
        return str(error)


@given(st.lists(WORDS, max_size=12).map("".join))
@example("a\t")
@example("|#")
@example("{a: b? c}")
@example("a: !")
@example("a\n\ufeff")
def test_the_swift_parser_changes_neither_value_nor_message(text: str) -> None:
    assert outcome(ours._load, text) == outcome(lambda t: yaml.load(t, Loader=ours._Loader), text)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_swift_parser_reads_what_ships(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = path.read_text()
    slow = yaml.load(text, Loader=ours._Loader)
    monkeypatch.setattr(ours, "_Loader", None)
    assert repr(ours._load(text)) == repr(slow)
