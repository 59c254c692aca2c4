"""The reference of the configuration is what the code says, and says something of every key."""

from __future__ import annotations

import json

import configuration
import pytest

from servod.cli.app import run
from servod.cli.config import ConfigKey, config_keys

KEYS = config_keys()


def test_the_page_is_current() -> None:
    """`python tests/tools/configuration.py` writes it again."""
    text = configuration.PAGE.read_text()
    assert configuration.with_table(text) == text


@pytest.mark.parametrize("key", KEYS, ids=lambda key: key.key)
def test_every_key_says_what_it_means(key: ConfigKey) -> None:
    assert len(key.meaning) > len("0x6002") and key.type
    if "none" in key.type.split():
        assert any(word in key.meaning for word in ("left out", "none:")), "says nothing of leaving it out"


def test_the_gear_ratio_says_which_way_round_it_is() -> None:
    (meaning,) = (key.meaning for key in KEYS if key.key == "amplifier.gear_ratio")
    assert "turns of the motor for one turn of the joint" in meaning and "motor angle / gear_ratio" in meaning


@pytest.mark.parametrize("key", [k for k in KEYS if k.type.startswith("number")], ids=lambda key: key.key)
def test_every_physical_number_has_a_unit_and_a_range(key: ConfigKey) -> None:
    assert key.unit and " to " in key.range


def test_the_command_prints_what_the_page_has(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "keys", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"keys": [key._asdict() for key in KEYS]}
    assert run(["config", "keys"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert all(f"{key.key} " in told and key.meaning in told for key in KEYS)


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("gear_ratio", ["amplifier.gear_ratio"]),
        ("encoder.direction", ["encoder.direction"]),
        ("counts_per_turn", ["amplifier.counts_per_turn", "encoder.counts_per_turn"]),
        ("metrics", ["metrics.http_port", "metrics.http_address", "metrics.textfile"]),
    ],
)
def test_a_key_its_last_part_or_a_group_is_explained(
    capsys: pytest.CaptureFixture[str], asked: str, answer: list[str]
) -> None:
    assert run(["config", "keys", asked, "--json"]) == 0
    assert [row["key"] for row in json.loads(capsys.readouterr().out)["keys"]] == answer


def test_a_key_that_is_none_is_one_line_with_the_likely_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["config", "keys", "gear_rato"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1 and "did you mean amplifier.gear_ratio?" in captured.err
