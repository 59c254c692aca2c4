"""`servoctl synthesize` end to end: options reach the set, what clashes is told, a relaxation is only offered."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servod.cli.app import run
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.formats.gains.parameters import LocalParameters
from servod.lab.synthesize import infeasible
from tests.lab.synthesize.designs import MODEL

AXES = MODEL.parent


def synthesize(tmp_path: Path, *options: str, model: Path = MODEL) -> tuple[int, Path]:
    out = tmp_path / "gains.yaml"
    return run(["synthesize", "--model", str(model), "--out", str(out), "--json", *options]), out


def law(gains: GainSet) -> LocalParameters:
    assert isinstance(gains.parameters, LocalParameters)
    return gains.parameters


def test_options_of_the_law_reach_the_set(tmp_path: Path) -> None:
    options = ["--no-observer", "--l", "0.02", "--weights", "cosine", "--velocity", "measured", "--paper-nodes"]
    loop = ["--overlap-from", "0.004", "--overlap-to", "0.03", "--encoder-counts", "131072", "--speed", "0.6"]
    code, out = synthesize(tmp_path, *options, *loop, "--leak", "3", "--alpha", "1.5", "--beta", "0.03")
    gains = load_gains(out)
    friction, regions, design = law(gains).friction, law(gains).regions, gains.design
    assert code == 0 and design is not None
    assert (friction.weights.value, friction.velocity.value, friction.leak_per_s) == ("cosine", "measured", 3.0)
    assert [s.gain for s in friction.sets] == [0.02] * 9 and law(gains).disturbance_observer is None
    assert (regions.overlap_from_rad_s, regions.overlap_to_rad_s) == (0.004, 0.03)
    assert (design.counts_per_turn, design.speed_max_rad_s) == (131072.0, 0.6)
    assert design.regions[1].position_weight == 1.5 and design.regions[1].torque_weight == 0.03


def test_the_delay_can_be_another_than_the_models(tmp_path: Path) -> None:
    code, out = synthesize(tmp_path, "--delay-s", "0.0015", "--no-observer", "--l", "0", "--uncertainty", "0.5")
    gains = load_gains(out)
    assert code == 0 and gains.design is not None
    assert gains.design.model.total_delay_s == 0.0015
    assert gains.design.uncertainty.inertia == 0.025


def test_what_is_known_over_position_is_fed_forward_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ["--no-observer", "--l", "0"]
    assert synthesize(tmp_path, *quick, model=AXES / "demo_joint.yaml")[0] == 0
    waves = json.loads(capsys.readouterr().out)["position_feedforward"]["waves"]
    assert [(w["amplitude_nm"], w["waves_per_turn"]) for w in waves] == [(0.002, 22.0), (0.0006, 44.0)]
    code, out = synthesize(tmp_path, *quick, "--no-position-torque", model=AXES / "demo_joint.yaml")
    assert code == 0 and law(load_gains(out)).position_feedforward is None


def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    code, out = synthesize(tmp_path, *options)
    captured = capsys.readouterr()
    assert code == 1 and not out.exists() and captured.err.count("\n") == 1
    told: dict[str, Any] = json.loads(captured.out)
    assert told["feasible"] is False and told["clashes"]
    return told


def test_the_reference_mode_names_what_clashes_and_its_offer_is_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = refused(tmp_path, capsys, "--mode", "reference", "--leak", "0")
    assert told["regions"] == ["low"] and any(line.startswith("norm: low: a=0") for line in told["clashes"])
    offer = next(r for r in told["relaxations"] if r["wish"].startswith("leak"))
    code, out = synthesize(tmp_path, "--mode", "reference", "--leak", str(offer["enough"]))
    design = load_gains(out).design
    assert code == 0 and design is not None and design.mode.value == "reference" and len(design.reference) == 2


def test_the_deployed_mode_names_what_clashes_and_its_offer_is_enough(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(infeasible, "RELAX_STEPS", 0)  # the search itself: tests/lab/synthesize/test_deployed.py
    wish = ["--cutoff-hz", "800", "--no-observer", "--l", "0"]
    told = refused(tmp_path, capsys, *wish, "--zeta-min", "0.15")
    assert set(told["regions"]) <= {"low", "high"} and all(":" in line for line in told["clashes"])
    offer = next(r for r in told["relaxations"] if r["wish"] == "least damping ratio")
    assert offer["asked"] == 0.15 and 0.0 < offer["enough"] < 0.15
    assert synthesize(tmp_path, *wish, "--zeta-min", str(0.98 * offer["enough"]))[0] == 0


def test_the_clash_is_told_in_lines_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    assert run(["synthesize", "--model", str(MODEL), "--out", str(out), "--mode", "reference", "--leak", "0"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("clash: ") for line in lines)
    assert any(line.startswith("would do by itself: leak") for line in lines)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--overlap-from", "0.03"], "--overlap-from"),
        (["--overlap-to", "0.6"], "--overlap-to"),
        (["--scalar-output"], "--scalar-output"),
        (["--alpha", "0"], "--alpha"),
        (["--zeta-min", "0.95"], "--zeta-min"),
        (["--delay-s", "1"], "--delay-s"),
        (["--weights", "square"], "--weights"),
    ],
)
def test_options_out_of_range_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], named: str
) -> None:
    assert synthesize(tmp_path, *options)[0] == 2
    captured = capsys.readouterr()
    assert named in captured.err and captured.err.count("\n") == 1
    assert json.loads(captured.out)["error"]["exit_code"] == 2


def test_the_papers_literal_output_is_an_option_of_the_reference_mode(tmp_path: Path) -> None:
    code, out = synthesize(tmp_path, "--mode", "reference", "--scalar-output")
    design = load_gains(out).design
    assert code == 0 and design is not None
    assert {proof.output.value for proof in design.reference} == {"scalar"}
