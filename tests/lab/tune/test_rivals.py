"""Whole tunings with small budgets: the same rules for all, and the local law ahead at equal feedback."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.formats.gains.gain_set import load_gains, require_certificate
from servod.lab.simulate.simulate import LoopSettings
from servod.lab.tracking.metrics import curves_of, paper_rows, run, score
from servod.lab.tune import Feedback, Tuned, rivals, tune
from servod.lab.tune.laws import RIVALS
from servod.lab.tune.rivals import needed, start_points
from tests.lab.identify.joints import draw
from tests.lab.tune.axis import joint, small

SCORING_SEED = 4711


@pytest.fixture(scope="module")
def field() -> dict[Feedback, dict[str, Tuned]]:
    told: list[tuple[str, float]] = []
    found = rivals(
        joint(),
        seed=1,
        budget=24,
        plan=small(),
        processes=2,
        on_progress=lambda name, share: told.append((name, share)),
    )
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert len({name for name, _ in told}) == 2 * len(RIVALS)
    return found


def test_every_rival_is_tuned_in_both_classes_within_its_budget(field: dict[Feedback, dict[str, Tuned]]) -> None:
    assert all(list(field[feedback]) == list(RIVALS) for feedback in Feedback)
    for tuneds in field.values():
        spent = {
            law: sum(t.simulations for name, t in tuneds.items() if RIVALS[name].law == law)
            for law in ("pd_dob", "pd_lugre", "local")
        }
        assert spent == dict.fromkeys(spent, 24)
    assert field[Feedback.EQUAL]["pd"].simulations == 2  # there is nothing to tune


def test_more_freedom_is_never_worse(field: dict[Feedback, dict[str, Tuned]]) -> None:
    for name in RIVALS:
        assert field[Feedback.FREE][name].cost <= field[Feedback.EQUAL][name].cost * (1.0 + 1e-9)


@pytest.mark.parametrize("feedback", list(Feedback))
def test_a_tuned_l_f_is_never_worse_than_a_fixed_one(
    field: dict[Feedback, dict[str, Tuned]], feedback: Feedback
) -> None:
    tuned = field[feedback]
    assert tuned["pd_lugre"].cost <= min(tuned[name].cost for name in RIVALS["pd_lugre"].forerunners) * (1.0 + 1e-9)


def test_who_is_started_from_is_tuned_too() -> None:
    fixed = RIVALS["pd_lugre"].forerunners
    found = needed(["pd", "pd_lugre"])
    assert {name for _, name in found} == {"pd", "pd_lugre", *fixed}
    assert all(found.index(before) < found.index(key) for key in found for before in start_points(key))


def test_processes_change_nothing(field: dict[Feedback, dict[str, Tuned]]) -> None:
    alone = tune(joint(), "pd_dob", Feedback.EQUAL, small(budget=24))
    assert alone.gains.pack() == field[Feedback.EQUAL]["pd_dob"].gains.pack()
    assert alone.cost == field[Feedback.EQUAL]["pd_dob"].cost


def test_a_tuned_set_says_what_it_is_and_is_not_certified(
    field: dict[Feedback, dict[str, Tuned]], tmp_path: Path
) -> None:
    for feedback, tuneds in field.items():
        for name, tuned in tuneds.items():
            gains = tuned.gains
            assert gains.name == f"tuned_{name}_{feedback.value}"
            assert "rival" in gains.description and gains.provenance.seed == 1
            (tmp_path / f"{gains.name}.yaml").write_text(gains.to_yaml())
            assert load_gains(tmp_path / f"{gains.name}.yaml") == gains
            with pytest.raises(BadInput, match="certificate"):
                require_certificate(gains, accept_uncertified=False)


def test_at_equal_feedback_the_local_law_is_ahead_on_a_plant_that_tuning_never_saw() -> None:
    """Tuned on one joint and its intervals, scored on another with other friction, cogging, noise and seeds."""
    plant = draw(5, bits=20).model.model_copy(update={"delay_s": 0.001})
    asymmetry = plant.asymmetry
    assert asymmetry is not None
    near = plant.model_copy(
        update={
            "inertia": 1.02 * plant.inertia,
            "friction": plant.friction.model_copy(update={"sigma0": 0.97 * plant.friction.sigma0}),
            "asymmetry": asymmetry.model_copy(
                update={
                    "positive_dry": 1.02 * asymmetry.positive_dry,
                    "negative_dry": 0.98 * asymmetry.negative_dry,
                }
            ),
        }
    )
    plan, loop = small(budget=60), LoopSettings(0.001, 2.0**20, 300.0, 0.3)

    def rms_mrad(name: str) -> float:
        tuned = tune(near, name, Feedback.EQUAL, plan)
        curves = curves_of(run(plant, tuned.gains, paper_rows(0.001, 10.0), loop, SCORING_SEED))
        return score(curves.time_s, curves.error_mrad).rms_error_mrad

    local = rms_mrad("local")
    assert local <= 0.20
    assert local <= 0.75 * rms_mrad("pd_lugre")
    assert local <= 0.55 * rms_mrad("pd_dob")
