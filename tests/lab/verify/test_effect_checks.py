"""Effects of a model in the loop check: ranges that are covered, ends against the kernels, springs, what stays out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.model.axis_model import AxisModel
from servod.formats.model.keys import Harmonic
from servod.kernels.physics.effects import dry_factor, ripple, thermal_factors
from servod.kernels.physics.layout import PlantState
from servod.lab.verify.checks import Subject
from servod.lab.verify.closed_loop import Behind, LinearBristle, LoopDeviation, Reach, corners, joint_point
from servod.lab.verify.effect_checks import check_effects, covered, effects_of, level_of
from servod.lab.verify.margins import Sweep, by_delay
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1, table1_set

WAVE = Harmonic(amplitude=0.05, periods_per_turn=6.0)


def model(**effects: object) -> AxisModel:
    return AxisModel.model_validate(table1().model_dump(exclude_none=True) | effects)


def checked(**effects: object) -> dict[str, CertificateCheck]:
    """The checks of effects of Table I's set for a model with `effects`, at few speeds."""
    gains = table1_set()
    assert gains.design is not None
    design = gains.design.model_copy(update={"model": model(**effects)})
    subject = Subject(gains, design, 1, 1, 1)
    subject.__dict__["coarse"] = subject.sweep(6)  # the cached sweep, for speed
    return {check.name: check for check in check_effects(subject)}


def told(**effects: object) -> str:
    found = model(**effects)
    return covered(effects_of(found, level_of(found, steady_friction(found), 0.5)))


@pytest.mark.parametrize(
    ("effects", "text"),
    [
        (
            {"thermal": {"dry_per_c": -0.004, "viscous_per_c": -0.01}},
            "dry friction x 0.96 to 1.04, viscous friction x 0.90 to 1.10 (15 to 35 degC): thermal",
        ),
        ({"thermal": {"dry_per_s": -0.005}}, "dry friction x 0.50 to 1.00 (15 to 35 degC, drift for 100 s): thermal"),
        ({"offset_drift": {"per_s": 0.001, "time_s": 5.0}}, "(offset drifts by 0.005 N*m): offset_drift"),
        ({"offset_drift": {"per_s": -0.001}}, "(offset drifts by -0.023 N*m after 22.5 s): offset_drift"),
        ({"torque_ripple": {"harmonics": [WAVE]}}, "gain x 0.95 to 1.05, slope 0.022 N*m/rad: torque_ripple"),
        ({"torque_gain": {"factor": 1.21, "negative_factor": 1.0}}, "gain x 0.91 to 1.10: torque_gain"),
        ({"torque_saturation": {"limit": 0.1, "shape": "tanh"}}, "gain x 0.47 to 1.00: torque_saturation"),
        ({"load_dependent_friction": {"per_load": 0.1}, "gravity": {"amplitude": 0.03}}, "dry friction x 1.00 to 1.07"),
    ],
)
def test_the_range_that_is_covered_is_told(effects: dict[str, object], text: str) -> None:
    assert told(**effects).startswith(text)


def test_the_ends_hold_what_the_kernels_do_over_travel_and_temperature() -> None:
    found = model(
        torque_ripple={"harmonics": [WAVE]},
        position_dependent_friction={"harmonics": [WAVE], "bumps": [{"position": 0.3, "width": 0.1, "factor": 0.4}]},
        thermal={"dry_per_c": -0.02, "viscous_per_c": -0.03, "shape": "exponential"},
    )
    effects, plant = effects_of(found, level_of(found, steady_friction(found), 0.5)), found.pack()
    positions = [float(x) for x in np.linspace(-math.pi, math.pi, 2000)]
    seen = {
        "torque_ripple": [ripple(*plant, x) for x in positions],
        "position_dependent_friction": [dry_factor(*plant, x) for x in positions],
        "thermal": [thermal_factors(plant.p, PlantState(), c)[0] for c in (15.0, 25.0, 35.0)],
    }
    for name, values in seen.items():
        low, high = effects[name].torque_gain if name == "torque_ripple" else effects[name].dry
        assert low <= min(values) + 1e-9 and max(values) <= high + 1e-9
        assert high - low < 1.3 * (max(values) - min(values))


def test_small_effects_are_certified_and_large_ones_are_not() -> None:
    small = checked(thermal={"dry_per_c": -0.004, "viscous_per_c": -0.012}, torque_ripple={"harmonics": [WAVE]})
    assert len(small) == 3 and all(check.passed for check in small.values()), small
    large = checked(torque_ripple={"harmonics": [Harmonic(amplitude=0.7, periods_per_turn=6.0)]})
    assert not all(check.passed for check in large.values())


def test_effects_that_the_loop_has_anyway_add_no_check() -> None:
    plain = checked(cogging={"harmonics": [WAVE.model_copy(update={"amplitude": 0.002})]}, torque_gain={"factor": 1.1})
    assert [check.value for check in plain.values()] == [0.0]
    assert all(check.passed for check in checked(torque_saturation={"limit": 0.3}).values())


@pytest.mark.parametrize(
    ("effects", "named"),
    [
        ({"actuator_lag": {"time_constant_s": 0.0005}}, None),
        ({"actuator_lag": {"time_constant_s": 0.003}}, None),
        ({"actuator_lag": {"slew_per_s": 5.0}}, "actuator_lag.slew_per_s turns the torque around in more than 5"),
        ({"torque_saturation": {"limit": 0.1}, "offset_drift": {"per_s": -1.0, "time_s": 0.02}}, None),
        (
            {"torque_saturation": {"limit": 0.1}, "offset_drift": {"per_s": -1.0, "time_s": 0.04}},
            "torque_saturation.limit",
        ),
        ({"torque_saturation": {"limit": 0.05}}, "torque_saturation.limit is below the 0.073 N*m of friction"),
        ({"load_dependent_friction": {"per_command": 0.95}}, "load_dependent_friction.per_command lets friction"),
    ],
)
def test_physics_that_no_pole_has_in_it_is_named(effects: dict[str, object], named: str | None) -> None:
    check = next(iter(checked(**effects).values()))
    assert check.passed == (named is None) and (named or "") in check.name


def test_a_stiff_spring_is_a_rigid_joint_and_a_soft_one_is_judged_by_its_resonance() -> None:
    friction = steady_friction(table1())
    rigid, stiff = (
        joint_point(friction, 0.1, LinearBristle.SLIDES, LoopDeviation(behind=behind)).matrices()[0]
        for behind in (None, Behind(0.0004, 1e7, 200.0, 0.0))
    )
    slow = np.sort(np.abs(np.linalg.eigvals(stiff)))[: len(rigid)]
    assert slow == pytest.approx(np.sort(np.abs(np.linalg.eigvals(rigid))), rel=1e-3, abs=1e-6)
    elastic = {"joint_elasticity": {"load_inertia": 0.0005, "stiffness": 20.0, "damping": 0.001}}
    judged = [check for name, check in checked(**elastic).items() if "spring" in name]
    assert len(judged) == 1 and "resonance at 45 Hz" in judged[0].name and not judged[0].passed


def test_a_gap_is_judged_without_its_load_as_well() -> None:
    gap = {"backlash": {"gap": 0.001, "load_inertia": 0.00002, "stiffness": 2000.0, "damping": 0.2}}
    found = [check for name, check in checked(**gap).items() if "any stiffness up to it, and none" in name]
    assert len(found) == 1 and found[0].passed


def test_joints_with_and_without_a_spring_are_judged_side_by_side() -> None:
    gains, friction = table1_set(), steady_friction(table1())
    assert gains.design is not None
    cases = [LoopDeviation(), LoopDeviation(behind=Behind(0.0003, 1e6, 10.0, 0.0))]
    assert by_delay(cases) == [[0], [1]]
    sweep = Sweep(gains.law, gains.pack(), friction, Subject(gains, gains.design, 1, 1, 1).timing, [0.1])
    together = sweep.worst(cases).coupled_radius
    assert together == max(sweep.worst([case]).coupled_radius for case in cases)


def test_corners_reach_as_far_as_interval_and_effect_together() -> None:
    gains = table1_set()
    assert gains.design is not None
    u = replace(Reach(), dry=(0.8, 1.1), torque_gain=(0.9, 1.2))
    wide = corners(gains.design.uncertainty, u)
    plain = corners(gains.design.uncertainty)
    assert min(c.dry for c in wide) == pytest.approx(0.8 * min(c.dry for c in plain))
    assert max(c.dry for c in wide) == pytest.approx(1.1 * max(c.dry for c in plain))
    light = min(wide, key=lambda c: c.inertia)
    assert light.torque_gain == pytest.approx(1.2 * max(c.torque_gain for c in plain))
