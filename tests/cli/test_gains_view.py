"""What `servoctl gains show` and `gains list` print is for people: words, units, no Python."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from servod.cli import gains
from servod.cli.app import run
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, parse_gains
from tests.formats.gains import good

#: What only Python prints.
PYTHON = re.compile(r"\b(None|True|False)\b|[{}]|'[a-z_]+':")
SHIPPED = ("demo_local_measured", "demo_pd_dob", "paper_pd_lugre", "table1_kz_kv_kx")


def shown(gain_set: GainSet, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> str:
    file = tmp_path / "set.yaml"
    file.write_text(gain_set.to_yaml())
    assert run(["gains", "show", str(file)]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("name", SHIPPED)
def test_a_set_of_each_law_is_shown_in_words(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["gains", "show", str(shipped(f"gains/{name}.yaml"))]) == 0
    text = capsys.readouterr().out
    assert PYTHON.search(text) is None
    assert "verdict: uncertified: no certificate; runs only with gains.accept_uncertified: true" in text


def test_parameters_have_unit_and_meaning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = shown(parse_gains(shipped("gains/demo_local.yaml").read_text(), "demo_local.yaml"), tmp_path, capsys)
    rows = [re.split(r"\s{2,}", line.strip()) for line in text.splitlines()]
    assert ["friction.stiffness_nm_per_rad", "760", "N·m/rad", "c0_hat"] in rows
    assert ["regions.low.k_v_s_per_rad", "1.2", "s/rad"] in rows
    assert ["disturbance_observer.inertia_kg_m2", "0.001", "kg·m²"] in rows
    assert ["velocity_rad_s [rad/s]", "decay_per_s [1/s]", "gain"] in rows
    assert ["-0.5", "10260.771", "0.04"] in rows


def test_verdict_and_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certified = good.certified(parse_gains(good.PD, "good"))
    text = shown(certified, tmp_path, capsys)
    assert "verdict: certified\n" in text and PYTHON.search(text) is None
    assert certified.certificate is not None
    assert all(check.name in text for check in certified.certificate.checks) and "passed" in text
    text = shown(certified.model_copy(update={"seal": "0" * 64}), tmp_path, capsys)
    assert "verdict: refused: numbers that were changed after the set was sealed; wanted: the file as" in text


def test_texts_of_a_file_do_not_act_on_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd = parse_gains(good.PD, "good").model_copy(update={"description": "\x1b[2Jgone [red]\nverdict: certified"})
    text = shown(odd, tmp_path, capsys)
    assert "\x1b" not in text and "[red] verdict: certified" in text


ROW = {"name": "bench", "version": 2, "law": "pd", "certified": True, "sha256": "ab" * 32, "warning": ""}


def test_the_list_says_what_runs_and_what_the_axis_refuses(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        ROW | {"active": True, "refused": ""},
        ROW | {"name": "by_hand", "active": False, "certified": False, "refused": ""},
        ROW | {"name": "old", "active": False, "refused": "gain set old: design.period_s: found 0.002; allowed: 0.001"},
    ]
    answer: dict[str, Any] = {"gains": rows}
    monkeypatch.setattr(gains, "ask", lambda *_: answer)
    assert run(["gains", "list"]) == 0
    text = capsys.readouterr().out
    lines = [line.split() for line in text.splitlines() if line.strip()]
    assert lines[1:4] == [
        ["bench", "2", "pd", "certified", "active", "ab" * 6],
        ["by_hand", "2", "pd", "uncertified", "ab" * 6],
        ["old", "2", "pd", "refused", "ab" * 6],
    ]
    assert "refused: old version 2: gain set old: design.period_s: found 0.002; allowed: 0.001" in text
    assert PYTHON.search(text) is None
    assert run(["gains", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == answer
