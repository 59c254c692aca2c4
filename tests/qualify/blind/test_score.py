"""The rules by which answers are scored, on answers written by hand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from servod.cli.app import app
from servod.common.errors import BadInput
from servod.qualify.blind import count, tables
from servod.qualify.blind.conceal import (
    CASES,
    FILE,
    SEALED,
    TRUTH,
    BlindTrial,
    conceal,
    read_truth,
    unlock,
    write_trial,
)
from servod.qualify.blind.document import document, score, write
from servod.qualify.blind.examine import ANSWERS, DIAGNOSIS, MODEL, RUN
from servod.qualify.blind.plan import CaseSpec, Cover, Settings, Sort, plans
from servod.qualify.blind.score import HeldOut, Scored, is_right, matches, parameters_of

RAN = {"exit_code": 0, "wall_s": 10.0, "cpu_s": 15.0, "memory_mib": 300.0, "time_limit_s": 12.0, "sources": "ab" * 32}


def quiet(_done: int, _of: int) -> None:
    """No progress."""


def finding(effect: str, confidence: float = 0.9, **values: tuple[float, float, float]) -> dict[str, Any]:
    """A finding as diagnosis.json has it; parameters are value, low, high."""
    parameters = {key: {"value": v, "unit": "1", "interval": [low, high]} for key, (v, low, high) in values.items()}
    return {"effect": effect, "confidence": confidence, "alternatives": [], "parameters": parameters}


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sealed trial of two cases: an offset, and nothing."""
    out = tmp_path_factory.mktemp("trial")
    base = plans(20, 7, Settings())[0].__dict__ | {"cover": Cover.NONE, "off": False, "other": False, "weight": False}
    made = [CaseSpec(**base | {"sort": Sort.SINGLE, "effects": ("torque_offset",)})]
    made.append(CaseSpec(**base | {"sort": Sort.NOTHING, "effects": ()}))
    write_trial(out, BlindTrial(2, 7, False, sha256=conceal(made, Settings(), out, quiet)))
    return out


def answered(trial: Path, tmp_path: Path, **answers: dict[str, Any]) -> Path:
    """A copy of the trial with answers; each case's answer extends the model that is believed."""
    out = tmp_path / "trial"
    unlock(trial)
    shutil.copytree(trial, out)
    for name, answer in answers.items():
        folder = out / ANSWERS / name
        folder.mkdir(parents=True)
        (folder / DIAGNOSIS).write_text(json.dumps(answer))
        model = yaml.safe_load((out / CASES / name / MODEL).read_text()) | answer.get("model", {})
        (folder / MODEL).write_text(yaml.safe_dump(model))
        (folder / RUN).write_text(json.dumps(RAN))
    return out


def scored(out: Path) -> dict[str, Any]:
    trial = BlindTrial(**json.loads((out / FILE).read_text()))
    return score(trial, out, quiet)


def test_a_right_answer_counts(trial: Path, tmp_path: Path) -> None:
    true = read_truth(trial, json.loads((trial / FILE).read_text())["sha256"])["c000"]["parameters"]["torque_offset"]
    offset = true["torque_offset"]
    near = finding("torque_offset", 0.9, torque_offset=(1.02 * offset, *sorted((0.9 * offset, 1.1 * offset))))
    model = {"torque_offset": offset}
    good = {"verdict": "missing_physics", "findings": [near], "model": model}
    found = scored(answered(trial, tmp_path, c000=good, c001={"verdict": "adequate", "findings": []}))
    assert found["table"]["single"]["right"] == found["table"]["nothing"]["right"] == 1
    told = {"parameters": 1, "missing": 0, "median_error": pytest.approx(0.02), "covered": 1.0}
    assert found["parameters"]["all"] == told
    assert found["held_out"]["after_over_before"]["median"] < 0.2
    assert found["held_out"]["after_over_true"]["median"] == pytest.approx(1.0, rel=1e-6)
    assert found["times"]["wall_s"]["median"] == 10.0
    assert found["confusion"]["torque_offset"] == {"torque_offset": 1}


def test_a_true_parameter_that_is_not_told_is_a_miss(trial: Path, tmp_path: Path) -> None:
    good = {"verdict": "missing_physics", "findings": [finding("torque_offset", 0.9)]}
    found = scored(answered(trial, tmp_path, c000=good))
    missed = {"parameters": 1, "missing": 1, "median_error": 1.0, "covered": 0.0}
    assert found["parameters"]["all"] == found["parameters"]["by_effect"]["torque_offset"] == missed
    assert "1 values, 1 of them not told" in tables.text(found)


def test_answers_of_two_diagnoses_are_not_mixed(trial: Path, tmp_path: Path) -> None:
    none = {"verdict": "adequate", "findings": []}
    out = answered(trial, tmp_path, c000=none, c001=none)
    assert "sources abababababab," in tables.text(scored(out))
    (out / ANSWERS / "c001" / RUN).write_text(json.dumps(RAN | {"sources": "cd" * 32}))
    with pytest.raises(BadInput, match="an answer of sources cdcdcdcdcdcd"):
        scored(out)


def test_windows_left_out_of_a_median_stand_beside_it(trial: Path) -> None:
    """Where the believed model is hardly worse than the true one, its ratio is counted of all cases alone."""
    truth = read_truth(trial, json.loads((trial / FILE).read_text())["sha256"])["c000"]
    cases = [
        Scored("c", truth, "adequate", (), False, (), HeldOut(before, after, 1.0))
        for before, after in ((2.0, 1.8), (10.0, 1.0), (20.0, 3.0))
    ]
    found = count.held_out(cases)
    assert found["after_over_before"]["count"] == 2
    assert found["after_over_before"]["median"] == pytest.approx(0.125)
    assert found["after_over_before_all"]["median"] == pytest.approx(0.15)
    shown = tables.markdown(document(BlindTrial(3, 7, False), cases))
    assert "2 of 3 cases: believed model 3 times the true one's" in shown
    assert "all 3 cases with an effect" in shown


def test_a_false_alarm_and_a_missing_answer_count_as_wrong(trial: Path, tmp_path: Path) -> None:
    alarm = {"verdict": "missing_physics", "findings": [finding("cogging", 0.6)]}
    out = answered(trial, tmp_path, c001=alarm)
    found = scored(out)
    assert found["table"]["single"]["right"] == found["table"]["nothing"]["right"] == 0
    assert found["false_alarms"] == {"c001": ["cogging"]}
    assert found["confusion"] == {"nothing": {"cogging": 1}, "torque_offset": {"no answer": 1}}
    assert [part["cases"] for part in found["calibration"]] == [0, 1, 0, 0, 0]
    write(found, out)
    assert json.loads((out / "prove.json").read_text()) == found
    assert "may have ended 1 diagnoses early" in (out / "prove.md").read_text()
    assert "cogging in c001" in (out / "prove.md").read_text()
    assert (out / "prove.html").read_text().count("<figure ") == 1
    assert {path.name for path in (out / "pictures").iterdir()} == {"confusion.png", "calibration.png"}


def test_the_command_refuses_a_broken_seal(trial: Path, tmp_path: Path) -> None:
    out = answered(trial, tmp_path)
    (out / SEALED / TRUTH).write_text("{}")
    run = CliRunner().invoke(app, ["prove", "--only", "score", "--out", str(out)])
    assert run.exit_code != 0
    assert "sealed was" in str(run.exception)


def test_the_command_refuses_another_trial_in_the_same_folder(trial: Path, tmp_path: Path) -> None:
    out = answered(trial, tmp_path)
    run = CliRunner().invoke(app, ["prove", "--only", "conceal", "--out", str(out), "--cases", "3", "--seed", "7"])
    assert "2 cases of seed 7" in str(run.exception)


def test_twins_count_as_one_where_the_answer_says_so() -> None:
    lag = finding("actuator_lag")
    assert matches(lag, ["delay"]) is None
    lag["alternatives"] = [{"effect": "delay", "experiment": ""}]
    assert matches(lag, ["delay"]) == "delay"
    assert matches(lag, ["cogging"]) is None


@pytest.mark.parametrize(
    ("sort", "verdict", "named", "effects", "right"),
    [
        (Sort.SINGLE, "missing_physics", {"cogging"}, ["cogging"], True),
        (Sort.SINGLE, "missing_physics", {"cogging", None}, ["cogging"], False),
        (Sort.PAIR, "missing_physics", {"cogging"}, ["cogging", "delay"], False),
        (Sort.NOTHING, "unexplained", set(), [], False),
        (Sort.UNKNOWN, "unexplained", set(), [], True),
        (Sort.UNKNOWN, "missing_physics", {None}, [], False),
        (Sort.UNKNOWN, "cannot_tell", set(), [], False),
    ],
)
def test_rules(sort: Sort, verdict: str, named: set[str | None], effects: list[str], right: bool) -> None:
    assert is_right(sort, verdict, named, effects) is right


def test_phases_are_compared_around_the_circle_and_ratios_from_one() -> None:
    true = {"parameters": {"cogging": {"phase": 6.2}, "asymmetry": {"negative_over_positive": 0.8}}}
    (phase,) = parameters_of(finding("cogging", phase=(0.0, -0.1, 0.1)), true)
    assert phase.error == pytest.approx(0.0832, abs=1e-3)
    assert phase.covered
    (ratio,) = parameters_of(finding("asymmetry", negative_over_positive=(0.82, 0.81, 0.83)), true)
    assert ratio.error == pytest.approx(0.1)
    assert not ratio.covered


def test_a_document_of_no_answers_still_makes_tables(trial: Path) -> None:
    found = document(BlindTrial(0, 1, True, sha256="0"), list[Scored]())
    assert "–" in tables.text(found)
    assert count.share(9, 10)["interval"] == [0.596, 0.982]
