"""`servoctl synthesize` and `servoctl verify` from file to file, with their exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from servod.cli.app import run
from servod.formats.gains.gain_set import load_gains
from tests.lab.deploy.sets import certified as certified_set
from tests.lab.synthesize.designs import MODEL, table1_set

pytestmark = pytest.mark.timeout(400)  # some 13 s on a quiet core; a busy machine is no finding


def test_from_a_model_to_a_certified_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    assert run(["synthesize", "--model", str(MODEL), "--out", str(out), "--name", "table1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["feasible"] and told["velocity_cutoff_hz"] >= 120.0
    assert run(["verify", str(out), "--json", "--plants", "4", "--processes", "1"]) == 1
    judged = json.loads(capsys.readouterr().out)
    assert [check["name"] for check in judged["checks"] if not check["passed"]] == ["plants of the Monte-Carlo"]
    assert all({"value", "limit", "margin"} <= set(check) for check in judged["checks"])
    assert load_gains(out).certificate_problem() == "a certificate that says valid: false"


def test_a_quick_look_revokes_no_certificate_and_one_that_finds_a_fault_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "gains.yaml"
    out.write_text(certified_set().to_yaml())
    assert load_gains(out).certificate_problem() is None
    whole = out.read_text()
    assert run(["verify", str(out), "--plants", "2", "--processes", "1"]) == 1
    assert out.read_text() == whole
    assert "keeps its valid certificate" in capsys.readouterr().err
    certified = load_gains(out)
    assert certified.design is not None
    unproven = certified.design.model_copy(update={"regions": []})
    out.write_text(certified.model_copy(update={"design": unproven}).sealed().to_yaml())
    assert load_gains(out).certificate_problem() is None
    assert run(["verify", str(out), "--plants", "2", "--processes", "1"]) == 1
    assert load_gains(out).certificate_problem() == "a certificate that says valid: false"


def test_one_number_changed_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    text = table1_set().to_yaml()
    out.write_text(text.replace("leak_per_s: 2.0", "leak_per_s: 2.5"))
    assert run(["verify", str(out), "--json"]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out)["valid"] is False
    assert "sealed" in captured.err and captured.err.count("\n") == 1
    judged = load_gains(out)
    assert judged.certificate is not None and not judged.certificate.valid and judged.seal_broken


def test_a_model_without_stiffness_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "model.yaml"
    model.write_text("inertia: 0.001\nfriction: {kind: coulomb_viscous, coulomb: 0.05}\n")
    assert run(["synthesize", "--model", str(model), "--out", str(tmp_path / "gains.yaml")]) == 2
    assert "friction.kind" in capsys.readouterr().err
