"""Small texts of the verbs: what is missing or old is said in words, and no figure stands for it."""

from __future__ import annotations

import json
from typing import Any

import pytest

from servod.cli import scan
from servod.cli.app import run
from servod.cli.track import _where


def test_a_node_without_a_serial_number_has_a_dash(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """CiA 301 asks for 0x1018:1 alone."""
    identity = {"device_type": 402, "vendor_id": 0x2A, "product_code": None, "revision": None, "serial": None}
    nodes = [{"node_id": 5, "identity": identity, "lss": None, "name": "drive"}]
    monkeypatch.setattr(scan, "_through_daemon", lambda _socket: nodes)
    assert run(["scan"]) == 0
    text = capsys.readouterr().out
    assert "0x2A" in text and "None" not in text
    assert run(["scan", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nodes"] == nodes


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (
            {"stale": False, "reference_rad": 0.1, "following_error_rad": 0.002},
            "reference +0.1000 rad, error +2.000 mrad",
        ),
        ({"stale": True, "reference_rad": 0.1, "following_error_rad": 0.002}, "no feedback of the joint"),
        ({"stale": False, "reference_rad": None, "following_error_rad": None}, ""),
    ],
)
def test_the_progress_of_a_motion_shows_no_old_error(motion: dict[str, Any], says: str) -> None:
    assert _where(motion) == says


def test_no_table_in_a_pipe_cuts_off_a_key(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    assert run(["faults", "--codes"]) == 0
    text = capsys.readouterr().out
    assert "…" not in text
    assert "limits.torque_rate_nm_per_s" in text and "limits.position_min_rad" in text
