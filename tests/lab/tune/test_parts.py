"""The parts of a tuning: ranges, the symmetric curve, the search, and what a gain set costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servod.lab.tune.laws import RIVALS, AxisFacts, Range, symmetric
from servod.lab.tune.plan import Feedback
from servod.lab.tune.tuning import TuningObjective, minimise, with_noise
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.tune.axis import joint, small

STARTS = {name: {**rival.fixed, **{key: r.start for key, r in rival.ranges.items()}} for name, rival in RIVALS.items()}


@pytest.mark.parametrize("ratios", [True, False])
def test_a_range_and_its_shares_are_inverse(ratios: bool) -> None:
    r = Range(2.0, 50.0, 10.0, ratios)
    assert (r.at(0.0), r.at(1.0)) == pytest.approx((2.0, 50.0))
    assert [r.at(r.share(value)) for value in (2.0, 7.0, 50.0)] == [2.0, 7.0, 50.0]
    tuned = [r.at(share) for share in np.linspace(0.0, 1.0, 50).tolist()]
    assert [r.at(r.share(value)) for value in tuned] == tuned


def test_the_symmetric_curve_is_the_joint_where_that_is_symmetric() -> None:
    curve = symmetric(steady_friction(joint(lean=0.0)), 0.5)
    assert curve.coulomb == pytest.approx(0.045, rel=0.03)
    assert curve.static == pytest.approx(0.07, rel=0.02)
    assert curve.stribeck_velocity == pytest.approx(0.1, rel=0.05)
    assert curve.viscous == pytest.approx(0.056, rel=0.05)


def test_the_symmetric_curve_of_a_leaning_joint_is_the_mean_of_both_directions() -> None:
    friction = steady_friction(joint())
    speed = np.array([0.002, 0.02, 0.1, 0.4])
    mean = [0.5 * (friction.torque(v) - friction.torque(-v)) for v in speed.tolist()]
    assert symmetric(friction, 0.5).torque(speed) == pytest.approx(mean, rel=0.02)


def valley(shares: np.ndarray) -> float:
    """A bent valley with its bottom at (0.7, 0.49, 0.2)."""
    x, y, z = shares
    return float((x - 0.7) ** 2 + 20.0 * (y - x * x) ** 2 + (z - 0.2) ** 2)


def test_the_search_finds_the_bottom_within_its_budget() -> None:
    calls = []

    def counted(shares: np.ndarray) -> float:
        calls.append(shares)
        return valley(shares)

    best = minimise(counted, [np.full(3, 0.5)], 150, 1)
    assert len(calls) <= 150
    assert valley(best) < 1e-3
    assert all(np.all((shares >= 0.0) & (shares <= 1.0)) for shares in calls)


def test_the_search_keeps_to_its_bounds_and_repeats_itself() -> None:
    def downhill(shares: np.ndarray) -> float:
        return float(np.sum(shares))

    first, again = (minimise(downhill, [np.full(2, 0.4)], 60, 3) for _ in range(2))
    assert np.all(first <= 1e-6)
    assert np.array_equal(first, again)


def test_the_search_is_never_worse_than_its_starts() -> None:
    starts = [np.array([0.9, 0.1, 0.9]), np.array([0.7, 0.49, 0.2])]
    assert valley(minimise(valley, starts, 3, 1)) == pytest.approx(0.0, abs=1e-12)


@pytest.fixture(scope="module")
def trial() -> TuningObjective:
    return TuningObjective(AxisFacts(joint(), small()))


def test_the_plants_are_draws_of_the_model_and_the_last_is_later(trial: TuningObjective) -> None:
    assert len({plant.inertia for plant in trial.plants}) == 2
    assert all(abs(plant.inertia / 0.001 - 1.0) < 0.06 for plant in trial.plants)
    assert [plant.delay_s for plant in trial.plants] == pytest.approx([0.001, 0.0015], abs=20e-6)
    other = TuningObjective(AxisFacts(joint(), small(seed=2)))
    assert {p.inertia for p in other.plants}.isdisjoint({p.inertia for p in trial.plants})


def test_the_papers_pd_is_the_measure_of_roughness(trial: TuningObjective) -> None:
    assert trial.cost(trial.axis.paper_pd()).roughness == pytest.approx(1.0)


def test_a_compensator_at_equal_feedback_costs_less_than_pd(trial: TuningObjective) -> None:
    pd = trial.cost(trial.axis.paper_pd()).value
    for name in ("pd_dob", "pd_lugre", "local"):
        parameters = RIVALS[name].build(trial.axis, STARTS[name])
        assert trial.cost(parameters).value < 0.25 * pd


def test_rough_torque_costs(trial: TuningObjective) -> None:
    """The same set under half the limit: a tenth over the limit doubles the cost."""
    parameters = RIVALS["pd_dob"].build(trial.axis, STARTS["pd_dob"] | {"bandwidth": 300.0})
    free = trial.cost(parameters)
    strict = TuningObjective(replace(trial.axis, plan=replace(trial.axis.plan, roughness_limit=free.roughness / 1.1)))
    assert strict.cost(parameters).value == pytest.approx(2.0 * free.value)


def test_a_set_that_shakes_the_joint_costs_more_than_none(trial: TuningObjective) -> None:
    wild = trial.cost(RIVALS["pd"].build(trial.axis, {"k_p": 1000.0, "k_d": 20.0}))
    assert wild.roughness > 20.0
    assert wild.value > trial.cost(trial.axis.paper_pd()).value


def test_a_larger_axis_gets_larger_gains_and_the_same_cost(trial: TuningObjective) -> None:
    large = TuningObjective(AxisFacts(joint(100.0), small(size=100.0)))
    assert large.axis.paper_pd().position_gain_nm_per_rad == pytest.approx(250.0)
    for name in ("pd_dob", "local"):
        costs = [t.cost(RIVALS[name].build(t.axis, STARTS[name])).value for t in (trial, large)]
        assert costs[1] == pytest.approx(costs[0], rel=0.02)


def test_noise_comes_from_the_identification_where_the_model_has_none() -> None:
    value = {"low": 0.0, "high": 1.0, "unit": "1"}
    model = joint().model_copy(update={"noise": None})
    identified = {
        "values": {"torque_noise_rms": value | {"value": 4e-4}, "encoder_noise_rms": value | {"value": 3e-6}},
        "friction_map": {"velocities": [-1.0, 1.0], "torques": [-1.0, 1.0], "half_widths": [0.1, 0.1]},
    }
    known = type(model).model_validate(model.model_dump(exclude_none=True) | {"identified": identified})
    noise = with_noise(known, 0.0).noise
    assert noise is not None
    assert (noise.torque_rms, noise.encoder_rms) == (4e-4, 3e-6)
    assert with_noise(model, 0.0).noise is None


def test_every_rival_has_the_feedback_of_its_class() -> None:
    axis = AxisFacts(joint(), small())
    for name, rival in RIVALS.items():
        assert set(rival.space(Feedback.FREE)) - set(rival.space(Feedback.EQUAL)) == {"k_p", "k_d"}
        parameters = rival.build(axis, STARTS[name]).model_dump()
        low = parameters.get("regions", {}).get("low")
        gains = (
            (parameters["position_gain_nm_per_rad"], parameters["velocity_gain_nms_per_rad"])
            if low is None
            else (0.1 * low["k_x_per_rad"], 0.1 * low["k_v_s_per_rad"])
        )
        assert gains == pytest.approx((2.5, 0.12))
