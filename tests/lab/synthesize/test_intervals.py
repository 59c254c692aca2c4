"""Intervals of a design: as wide as they were measured, never narrower than a floor, assumed where not measured."""

from __future__ import annotations

import pytest

from servod.common.yaml import validate
from servod.formats.gains.design import Uncertainty
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.identified import IdentifiedValue
from servod.lab.synthesize.regions import narrowed, uncertainty_of
from servod.lab.verify.checks import Subject, check_intervals
from servod.lab.verify.steady_friction import steady_friction
from servod.lab.verify.vertices import ASSUMED_DAMPING, FLOORS
from tests.lab.synthesize.designs import table1, table1_set

SPEEDS = (0.005, 0.02, 0.05, 0.1, 0.2, 0.5)


def identified(half_share: float, map_half_nm: float, *, damping: bool = True) -> AxisModel:
    """A joint as an identification writes it, every value with this half width."""

    def value(number: float) -> dict[str, object]:
        return {"value": number, "low": number * (1 - half_share), "high": number * (1 + half_share), "unit": "SI"}

    numbers = {"inertia": 0.001, "sigma0": 950.0} | ({"sigma1": 1.0} if damping else {})
    for side in ("positive", "negative"):
        curve = {"static": 0.07, "coulomb": 0.045, "stribeck_velocity": 0.1, "exponent": 2.0, "viscous": 0.056}
        numbers |= {f"{name}_{side}": number for name, number in curve.items()}
    friction = steady_friction(table1())
    torques = [friction.torque(v) for v in SPEEDS]
    velocities = [-v for v in reversed(SPEEDS)] + list(SPEEDS)
    both = [-t for t in reversed(torques)] + torques
    return validate(
        {
            "inertia": 0.001,
            "friction": {
                "kind": "local",
                "sigma0": 950.0,
                "sigma1": 1.0,
                "viscous": 0.05,
                "velocities": velocities,
                "torques": both,
            },
            "identified": {
                "values": {name: value(number) for name, number in numbers.items()},
                "friction_map": {"velocities": velocities, "torques": both, "half_widths": [map_half_nm] * len(both)},
                "not_identifiable": {} if damping else {"sigma1": "a finer encoder"},
            },
        },
        AxisModel,
        "identified",
    )


def test_a_model_that_nobody_measured_gets_the_defaults() -> None:
    assert uncertainty_of(table1()) == Uncertainty()


def test_wide_intervals_are_taken_as_they_are_and_narrow_ones_at_their_floor() -> None:
    wide, narrow = uncertainty_of(identified(0.3, 0.004)), uncertainty_of(identified(0.001, 1e-5))
    assert (wide.inertia, wide.stiffness, wide.damping, wide.viscous) == pytest.approx((0.3,) * 4, rel=1e-9)
    assert wide.slope == pytest.approx(2.0**0.5 * 0.004 / 0.025)
    assert narrow.model_dump(exclude={"torque_gain"}) == FLOORS  # the delay, of which nothing was said, by default
    friction = steady_friction(table1())
    assert wide.dry == pytest.approx(0.004 / min(friction.torque(v) for v in SPEEDS))
    assert wide.torque_gain == 0.0  # torques are identified in units of the command


def test_the_wider_side_counts_and_nothing_is_cut_at_half() -> None:
    model = identified(0.001, 1e-5)
    assert model.identified is not None
    values = dict(model.identified.values)
    values["sigma1"] = values["sigma1"].model_copy(update={"low": 0.9, "high": 1.7})
    values["delay_s"] = IdentifiedValue(value=0.001, low=0.00093, high=0.00101, unit="s")
    known = model.identified.model_copy(update={"values": values})
    found = uncertainty_of(model.model_copy(update={"identified": known}))
    assert found.damping == pytest.approx(0.7) and found.delay_s == pytest.approx(7e-5)


def test_a_lag_that_may_hide_in_the_delay_does_not_widen_it() -> None:
    """As a part of the delay it turns the phase no further; where a lag was told, the delay stands for itself."""
    model = identified(0.001, 1e-5)
    assert model.identified is not None
    delay = IdentifiedValue(value=0.001, low=0.0008, high=0.00105, unit="s")

    def width(lag: IdentifiedValue) -> float:
        values = model.identified.values | {"delay_s": delay, "lag_s": lag}
        known = model.identified.model_copy(update={"values": values})
        return uncertainty_of(model.model_copy(update={"identified": known})).delay_s

    assert width(IdentifiedValue(value=0.0, low=0.0, high=0.00016, unit="s")) == pytest.approx(5e-5)
    assert width(IdentifiedValue(value=0.0, low=0.0, high=0.00010, unit="s")) == pytest.approx(1e-4)
    assert width(IdentifiedValue(value=0.001, low=0.0009, high=0.0011, unit="s")) == pytest.approx(2e-4)
    assert width(IdentifiedValue(value=0.001, low=0.0009, high=0.0013, unit="s")) == pytest.approx(3.5e-4)


def test_a_design_narrower_than_what_was_measured_is_not_certified() -> None:
    gains, model = table1_set(), identified(0.3, 0.004)
    assert gains.design is not None
    wide = uncertainty_of(model)
    for widths, passed in ((wide, True), (wide.scaled(0.5), False)):
        design = gains.design.model_copy(update={"model": model, "uncertainty": widths})
        check = next(check_intervals(Subject(gains, design, 1, 1, 1)))
        assert check.passed == passed and ("stiffness" in check.name) == (not passed)


@pytest.mark.parametrize("measured", [True, False])
def test_intervals_below_the_floors_are_not_certified_whether_measured_or_not(measured: bool) -> None:
    gains, model = table1_set(), identified(0.001, 1e-5) if measured else table1()
    assert gains.design is not None
    wide = uncertainty_of(model)
    for widths, passed in ((wide, True), (wide.model_copy(update={"inertia": 0.001}), False)):
        design = gains.design.model_copy(update={"model": model, "uncertainty": widths})
        check = list(check_intervals(Subject(gains, design, 1, 1, 1)))[1]
        assert check.passed == passed and ("inertia" in check.name) == (not passed)
        assert ("intervals not measured" in check.name) == (not measured)


@pytest.mark.parametrize("model", [table1(), identified(0.3, 0.004), identified(0.001, 1e-5)])
@pytest.mark.parametrize("factor", [0.02, 0.5, 0.9])
def test_what_is_narrowed_may_still_be_certified(model: AxisModel, factor: float) -> None:
    """An offer that is taken is not refused by the next step."""
    gains, asked = table1_set(), uncertainty_of(model).scaled(1.5)
    assert gains.design is not None
    found = narrowed(asked, factor, model)
    assert found != asked and all(getattr(found, key) <= getattr(asked, key) for key in FLOORS)
    design = gains.design.model_copy(update={"model": model, "uncertainty": found})
    assert [check.name for check in check_intervals(Subject(gains, design, 1, 1, 1)) if not check.passed] == []


def test_a_delay_that_may_be_none_at_all_is_not_below_it() -> None:
    """On a spring the interval of the delay reaches below zero; no torque comes before its command."""
    gains, model = table1_set(), identified(0.01, 1e-4)
    assert gains.design is not None and model.identified is not None
    delay = IdentifiedValue(value=0.001, low=-0.00005, high=0.0015, unit="s")
    known = model.identified.model_copy(update={"values": model.identified.values | {"delay_s": delay}})
    model = model.model_copy(update={"identified": known, "delay_s": 0.001})
    design = gains.design.model_copy(update={"model": model, "uncertainty": uncertainty_of(model)})
    assert [check.name for check in check_intervals(Subject(gains, design, 1, 1, 1)) if not check.passed] == []


def test_an_assumed_damping_has_the_interval_of_an_assumption() -> None:
    assert uncertainty_of(identified(0.001, 1e-5, damping=False)).damping == ASSUMED_DAMPING


def test_the_slope_is_that_of_the_fitted_curve_not_of_the_lines_between_nodes() -> None:
    truth, found = steady_friction(table1()), steady_friction(identified(0.01, 1e-4))
    for v in (-0.07, 0.01, 0.03, 0.07, 0.15):
        slope = found.dry_slope(v) + found.viscous(v)
        assert slope == pytest.approx(truth.dry_slope(v) + truth.viscous(v), abs=1e-6)
