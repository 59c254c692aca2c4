"""What a trial draws: the mix, the format of the cases, the seal."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml

from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.lab.recordings import Quantity, load_recording
from servod.lab.simulate.replay import Drive, replay
from servod.qualify.blind.conceal import (
    CASES,
    HOLDOUT,
    SEALED,
    SEEN,
    TRUTH,
    conceal,
    has_thermometer,
    make_case,
    open_cases,
    read_truth,
    unlock,
)
from servod.qualify.blind.concealed import NO_THERMOMETER, Concealed
from servod.qualify.blind.engine import CONCEALS
from servod.qualify.blind.hidden import HIDE, UNLISTED
from servod.qualify.blind.plan import (
    ALIKE,
    FAMILIES,
    HARDER,
    CaseSpec,
    Cover,
    Engine,
    Settings,
    Sort,
    plans,
    settings_of,
)


def quiet(_done: int, _of: int) -> None:
    """No progress."""


def planned(sort: Sort, effects: tuple[str, ...], **more: object) -> CaseSpec:
    """A plan of seed 7 that conceals `effects`."""
    base = next(p for p in plans(20, 7, Settings()) if p.sort is sort)
    fields = {"sort": sort, "effects": effects, "cover": Cover.NONE, "off": False, "other": False, "weight": False}
    return CaseSpec(**{**base.__dict__, **fields, **more})


def test_every_name_comes_in_turn_and_every_kind_has_its_share() -> None:
    made = plans(120, 4, Settings())
    counts = Counter(plan.sort for plan in made)
    assert counts == {Sort.SINGLE: 60, Sort.PAIR: 24, Sort.NOTHING: 22, Sort.UNKNOWN: 14}
    singles = Counter(plan.effects[0] for plan in made if plan.sort is Sort.SINGLE)
    assert set(singles) == set(HIDE) and set(singles.values()) == {2, 3}
    assert {plan.effects[0] for plan in made if plan.sort is Sort.UNKNOWN} == set(UNLISTED)
    assert {plan.cover for plan in made} == set(Cover)
    assert plans(120, 4, Settings()) == made != plans(120, 5, Settings())


def test_cases_that_conceal_nothing_come_on_top() -> None:
    made = plans(20, 4, Settings(), null=30)
    assert len(made) == 50 and sum(plan.sort is Sort.NOTHING for plan in made) == 34
    assert [plan.sort for plan in plans(0, 4, Settings(), null=3)] == [Sort.NOTHING] * 3


def test_another_engine_conceals_what_it_has_means_for() -> None:
    made = plans(60, 4, settings_of(False, Engine.MUJOCO))
    counts = Counter(plan.sort for plan in made)
    assert counts == {Sort.SINGLE: 37, Sort.PAIR: 12, Sort.NOTHING: 11}
    assert {effect for plan in made for effect in plan.effects} == set(CONCEALS)
    assert not any(plan.other for plan in made)


def test_another_engine_records_the_same_axis() -> None:
    plan = planned(Sort.SINGLE, ("cogging",))
    own, other = (make_case(plan, Settings(engine=engine)) for engine in Engine)
    assert own.truth["params"] == other.truth["params"] and own.model == other.model
    for name, columns in own.recordings.items():
        torque = other.recordings[name]["torque_nm"]
        assert 0.0 < np.std(torque - columns["torque_nm"]) < 0.1 * np.std(torque)


def test_pairs_are_of_effects_that_data_can_tell_apart() -> None:
    family = {name: number for number, row in enumerate(FAMILIES) for name in row}
    assert set(family) == set(HIDE)
    for plan in plans(200, 1, Settings()):
        if plan.sort is Sort.PAIR:
            first, second = plan.effects
            assert family[first] != family[second]
            assert {first, second} not in ALIKE


def test_an_effect_shows_and_the_same_plan_makes_the_same_case() -> None:
    plan = planned(Sort.SINGLE, ("torque_ripple",))
    first, again = make_case(plan, Settings()), make_case(plan, Settings())
    assert first.truth["strength"][0] >= SEEN
    assert first.truth == again.truth
    for name, columns in first.recordings.items():
        for column, values in columns.items():
            assert np.array_equal(values, again.recordings[name][column])


@pytest.mark.parametrize("seed", [3, 5])
def test_a_limit_is_met_in_what_is_recorded(seed: int) -> None:
    """An effect is judged by the motions that are recorded, not by others of their kind."""
    case = make_case(planned(Sort.SINGLE, ("torque_saturation",), seed=seed), Settings())
    most = max(float(np.max(np.abs(r["torque_nm"]))) for name, r in case.recordings.items() if name != "holdout")
    assert most > 1.05 * case.truth["parameters"]["torque_saturation"]["limit"]


def test_that_temperatures_are_missing_tells_nothing() -> None:
    asked = Concealed({}, thermometer=True)
    chance = [has_thermometer([Concealed({})], seed) for seed in range(1000)]
    assert np.mean(chance) == pytest.approx(1.0 - NO_THERMOMETER, abs=0.05)
    assert chance == [has_thermometer([], seed) for seed in range(1000)]
    assert all(has_thermometer([Concealed({}), asked], seed) for seed in range(20))
    for told in (True, False):
        case = make_case(planned(Sort.NOTHING, (), seed=chance.index(told)), Settings())
        assert {"temperature_c" in columns for columns in case.recordings.values()} == {told}


def test_harder_cases_have_clutter_noise_and_other_forms() -> None:
    easy, hard = (make_case(planned(Sort.NOTHING, ()), settings) for settings in (Settings(), HARDER))
    assert easy.truth["true_model"] == hard.truth["true_model"]  # clutter is not worth naming
    assert set(hard.truth["params"]) > set(easy.truth["params"])
    errors = []
    for case in (easy, hard):
        rows = case.recordings["holdout"]
        told = [rows[key] for key in ("t_s", "torque_nm", "position_rad")]
        drive = Drive(*told, rows.get("temperature_c", np.full(len(told[0]), np.nan)))
        errors.append(replay(AxisModel.model_validate(case.truth["true_model"]), drive, 0.25).rms)
    assert errors[1] > 1.5 * errors[0]
    assert all(plan.other for plan in plans(60, 1, HARDER) if plan.sort is Sort.SINGLE)


def test_what_friction_can_take_up_the_model_has_taken_up() -> None:
    open_case, absorbed = (
        make_case(planned(Sort.SINGLE, ("load_dependent_friction",), cover=cover), Settings())
        for cover in (Cover.NONE, Cover.ABSORBED)
    )
    more = absorbed.model["friction"]["coulomb"] / open_case.model["friction"]["coulomb"]
    assert more == pytest.approx(1.08)
    assert absorbed.truth["true_model"] == open_case.truth["true_model"]


def test_a_sealed_case_has_no_truth_in_its_folder(tmp_path: Path) -> None:
    made = [planned(Sort.SINGLE, ("thermal",), seed=1), planned(Sort.UNKNOWN, ("chaotic_load",), off=True)]
    digest = conceal(made, Settings(), tmp_path, quiet)
    names = {path.name for path in (tmp_path / CASES).rglob("*") if path.is_file()}
    assert names == {"model.yaml", "rec_0_slow_sine.csv.gz", "rec_1_multisine.csv.gz", "rec_2_moves.csv.gz"}
    folder = tmp_path / CASES / "c000"
    assert load_axis_model(folder / "model.yaml").friction is not None
    recording = load_recording(folder / "rec_0_slow_sine.csv.gz", None)
    assert {Quantity.TORQUE, Quantity.POSITION, Quantity.REFERENCE} <= set(recording.columns)
    truth = read_truth(tmp_path, digest)
    assert truth["c000"]["effects"] == ["thermal"]
    assert (truth["c001"]["effects"], truth["c001"]["unknown"]) == ([], "chaotic_load")


def test_a_truth_that_was_changed_is_refused(tmp_path: Path) -> None:
    digest = conceal([planned(Sort.NOTHING, ())], Settings(), tmp_path, quiet)
    path, held = tmp_path / SEALED / TRUTH, tmp_path / SEALED / "c000" / f"{HOLDOUT}.csv.gz"
    assert [sealed.stat().st_mode & 0o777 for sealed in (path, held)] == [0, 0]
    unlock(tmp_path)
    whole = json.loads(path.read_text())
    assert len(whole["salt"]) == 32
    whole["cases"]["c000"]["effects"] = ["cogging"]
    path.write_text(json.dumps(whole))
    with pytest.raises(ValueError, match="sealed was " + digest):
        read_truth(tmp_path, digest)


def test_open_cases_have_everything_in_them(tmp_path: Path) -> None:
    open_cases([planned(Sort.PAIR, ("cogging", "stribeck"))], Settings(), tmp_path, quiet)
    folder = tmp_path / "c000"
    truth = yaml.safe_load((folder / "truth.yaml").read_text())
    assert truth["effects"] == ["cogging", "stribeck"]
    assert set(truth["parameters"]) == {"cogging", "stribeck"}
    assert (folder / "holdout.csv.gz").exists()
    believed = load_axis_model(folder / "model.yaml")
    assert believed.friction.model_dump()["static"] == pytest.approx(truth["coulomb"])
