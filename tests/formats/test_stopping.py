"""What a configuration says of its stop: where the joint is from, what is narrowed, and by how much."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.common.yaml import validate
from servod.formats.config import AxisConfig
from servod.formats.config_guards import weakened
from servod.formats.joint_bounds import joint_of
from servod.formats.model.axis_model import load_axis_model
from servod.formats.stopping import Stopping, with_stopping
from servod.kernels.stopping import both_ways
from servod.qualify.faults.scenario import merged, shipped_config

SOON_S, HEARTBEAT_S = 0.02, 0.15
LIGHT = {"least_inertia": 0.001, "least_friction_nm": 0.005}


def axis(stopping: dict[str, Any] | None = None, **over: Any) -> AxisConfig:
    limits = {"torque_nm": 0.3, "speed_rad_s": 3.0, "position_min_rad": -0.6, "position_max_rad": 0.6}
    own = {"limits": {**limits, "stale_cycles": 5}, "stopping": stopping or {}}
    return validate(merged(merged(shipped_config(), own), over), AxisConfig, "axis")


def stated(config: AxisConfig, reaction_s: float = SOON_S) -> Stopping:
    found = with_stopping(config, reaction_s)[1]
    assert found is not None
    return found


def test_nothing_is_stated_of_a_joint_that_nobody_knows() -> None:
    config = axis()
    assert with_stopping(config, SOON_S) == (config, None)


def test_speed_torque_and_ramp_are_narrowed_and_it_is_said_by_how_much() -> None:
    narrow, stopping = with_stopping(axis(LIGHT), HEARTBEAT_S)
    assert stopping is not None
    assert narrow.limits.speed_rad_s == stopping.facts.speed_rad_s == 3.0
    assert narrow.stopping.deceleration_rad_s2 == pytest.approx(0.8 * 0.305 / 0.001)
    assert stopping.torque_at_rest_nm == pytest.approx(0.005 + 0.001 * 3.45 / stopping.facts.hold_s)
    assert stopping.torque_at_rest_nm < 0.03
    assert stopping.time_s <= 0.3
    assert stopping.speed_rad_s == pytest.approx(3.6)
    (torque,) = stopping.narrowed
    assert torque.startswith("limits.torque_nm 0.3 towards the motion is narrowed to 0.0274 N*m at rest")
    assert any(torque in line for line in stopping.lines())


def test_a_heavy_joint_gets_the_speed_that_it_brakes_from_in_time() -> None:
    heavy = {"least_inertia": 0.02, "least_friction_nm": 0.01}
    narrow, stopping = with_stopping(axis(heavy), SOON_S)
    assert stopping is not None
    assert narrow.limits.speed_rad_s < 0.4
    assert stopping.time_s == pytest.approx(0.06, rel=1e-3)
    assert "limits.speed_rad_s 3 is narrowed to" in stopping.narrowed[0]
    assert with_stopping(axis({**heavy, "within_s": 1.0}), SOON_S)[0].limits.speed_rad_s == 3.0


def test_a_range_that_is_too_small_for_the_speed_narrows_it() -> None:
    stopping = stated(axis({**LIGHT, "within_s": 1.0, "deceleration_rad_s2": 5.0}))
    assert stopping.travel_rad == pytest.approx(1.2, rel=1e-3)
    assert stopping.facts.speed_rad_s == pytest.approx(stopping.speed_rad_s / 1.2) != 3.0


def test_a_load_that_friction_does_not_hold_is_said_plainly() -> None:
    stopping = stated(axis({**LIGHT, "least_inertia": 0.01, "within_s": 1.0, "load_min_nm": -0.05}))
    assert stopping.document()["coasts_rad"] is None
    assert "does not rest by itself: a load of 0.05 N*m is not held by 0.005 N*m of friction" in stopping.lines()[1]
    assert stopping.facts.speed_rad_s == pytest.approx(3.0)
    held = stated(axis({**LIGHT, "load_min_nm": -0.004}))
    assert held.document()["coasts_rad"] > held.travel_rad


def test_a_drive_that_switches_off_lets_the_joint_coast_and_that_counts() -> None:
    off = {"amplifier": {"heartbeat_reaction": 2}}
    stopping = stated(axis({**LIGHT, "within_s": 1.0}, **off))
    assert stopping.facts.deceleration_rad_s2 == 0.0
    assert stopping.time_s == pytest.approx(0.103)  # the ramp-down of a loop that lost its supervisor takes longer
    assert stopping.travel_rad == pytest.approx(1.2, rel=1e-3)
    assert stopping.facts.speed_rad_s < 3.0
    with pytest.raises(BadInput, match="with a drive that does not brake"):
        with_stopping(axis({"least_inertia": 0.001}, **off), SOON_S)


@pytest.mark.parametrize(
    ("amplifier", "more_s"),
    [
        ({"brake": {"by": "drive", "engage_s": 0.1}}, 0.1),
        ({"brake": {"by": "output", "output_bit": 16, "engage_s": 0.1}}, 0.12),
        ({"quick_stop_option": 6}, 0.02),
    ],
)
def test_the_torque_that_holds_until_the_brake_is_closed_is_stated(amplifier: dict[str, Any], more_s: float) -> None:
    """What brings the joint to rest is as before; at rest it is held for so much longer."""
    plain, held = stated(axis(LIGHT)), stated(axis(LIGHT, amplifier=amplifier))
    assert held.time_s == pytest.approx(plain.time_s + more_s)
    assert held.facts == plain.facts
    assert (plain.held_s, held.held_s) == (0.0, pytest.approx(more_s))
    assert "after a loss of the master torque is gone within 57 ms" in plain.statement()[0]
    both = "the joint is at rest within 57 ms and torque, which holds it on purpose until then, is gone within"
    assert f"{both} {57 + 1e3 * more_s:.0f} ms" in held.statement()[0]
    by_output_and_stays = axis(LIGHT, amplifier={"brake": {"by": "output", "output_bit": 16}, "quick_stop_option": 6})
    assert any("until it is switched off" in line for line in stated(by_output_and_stays).statement())
    assert not any("until it is switched off" in line for line in held.statement())


@pytest.mark.parametrize("amplifier", [{"quick_stop_option": 6}, {"brake": {"by": "drive", "engage_s": 0.2}}])
def test_the_joint_rests_within_the_stated_time_and_the_torque_that_holds_it_is_gone_later(
    amplifier: dict[str, Any],
) -> None:
    heavy = {"least_inertia": 0.02, "least_friction_nm": 0.01, "within_s": 0.12}
    stopping = stated(axis(heavy, amplifier=amplifier))
    assert stopping.time_s - stopping.held_s == pytest.approx(0.12, rel=1e-3)
    assert "the joint is at rest within 120 ms (stopping.within_s)" in stopping.narrowed[0]
    assert "torque is gone within 120 ms (stopping.within_s)" in stated(axis(heavy)).narrowed[0]


def test_lost_commands_without_a_deadline_are_said_to_be_in_no_figure() -> None:
    unguarded = axis(LIGHT, heartbeat={"command_deadline_ms": 0})
    (note,) = set(stated(unguarded, HEARTBEAT_S).statement()) - set(stated(axis(LIGHT), HEARTBEAT_S).statement())
    assert note.startswith("stopping: commands alone lost, the master alive: not in these figures")


def test_a_ramp_that_nobody_writes_is_none_unless_it_is_stated() -> None:
    assert with_stopping(axis(LIGHT), SOON_S, writes_ramp=False)[1].facts.deceleration_rad_s2 == 0.0
    told = axis({**LIGHT, "deceleration_rad_s2": 100.0})
    assert with_stopping(told, SOON_S, writes_ramp=False)[1].facts.deceleration_rad_s2 == 100.0
    falls = {"load_min_nm": -0.05, **LIGHT}
    with pytest.raises(BadInput, match=r"stopping\.deceleration_rad_s2"):
        with_stopping(axis(falls), SOON_S, writes_ramp=False)


def test_the_joint_is_the_model_s_unless_it_is_stated(tmp_path: Path) -> None:
    model = tmp_path / "model.yaml"
    model.write_text(
        "inertia: 0.002\nfriction: {kind: coulomb_viscous, coulomb: 0.04, viscous: 0.02}\n"
        "asymmetry: {negative_dry: 0.5}\ngravity: {amplitude: 0.1}\n"
        "cogging: {harmonics: [{amplitude: 0.01, periods_per_turn: 22}]}\n"
    )
    joint = joint_of(axis(model=str(model)))
    assert joint is not None
    assert (joint.least_inertia, joint.most_inertia) == pytest.approx((0.0018, 0.0022))
    assert (joint.friction_nm, joint.viscous) == pytest.approx((0.01, 0.01))
    assert joint.load_max_nm == pytest.approx(0.1 * 0.564642 + 0.01, rel=1e-4)  # sin(0.6)
    assert joint.load_min_nm == pytest.approx(-joint.load_max_nm)
    told = joint_of(axis({"least_inertia": 0.001, "load_min_nm": 0.0, "least_friction_nm": 0.0}, model=str(model)))
    assert told is not None
    assert (told.least_inertia, told.most_inertia, told.load_min_nm, told.friction_nm) == (0.001, 0.0022, 0.0, 0.0)


def test_the_design_of_the_first_gain_set_knows_the_joint_too() -> None:
    joint = joint_of(axis(gains={"initial": str(shipped("gains/demo_local_certified.yaml"))}))
    assert joint is not None
    assert "design of the first gain set" in joint.source
    assert 0.0008 < joint.least_inertia < joint.most_inertia < 0.0013


def test_what_the_test_of_the_wiring_expects_is_better_than_nothing() -> None:
    joint = joint_of(axis(wiring_proof={"inertia": 0.001, "friction_nm": 0.07}))
    assert joint is not None
    assert (joint.least_inertia, joint.friction_nm) == pytest.approx((0.0009, 0.035))
    assert joint.assumed == ("assumed: no load (stopping.load_min_nm, load_max_nm)",)


DRY = {"kind": "coulomb_viscous", "coulomb": 0.01, "viscous": 0.002}


def modelled(folder: Path, stopping: dict[str, Any] | None = None, **effects: Any) -> AxisConfig:
    path = folder / "model.yaml"
    path.write_text(yaml.safe_dump({"inertia": 0.001, "delay_s": 0.001, "friction": DRY, **effects}))
    return axis(stopping, model=str(path))


@pytest.mark.parametrize("factor", [0.5, 2.0, 4.0])
def test_a_drive_that_gives_more_than_it_is_told_is_a_lighter_joint(factor: float, tmp_path: Path) -> None:
    """Torque = factor*command: the same motion as of a joint with a part of everything, told in torques of commands."""
    gained = stated(modelled(tmp_path, torque_gain={"factor": factor}))
    lighter = {"kind": "coulomb_viscous", "coulomb": 0.01 / factor, "viscous": 0.002 / factor}
    plain = stated(modelled(tmp_path, inertia=0.001 / factor, friction=lighter))
    assert gained.facts == pytest.approx(plain.facts)
    assert (gained.travel_rad, gained.time_s) == pytest.approx((plain.travel_rad, plain.time_s))
    assert gained.energy_j == pytest.approx(factor * plain.energy_j)


def test_what_the_drive_cannot_brake_with_it_does_not_brake_with(tmp_path: Path) -> None:
    stopping = stated(modelled(tmp_path, torque_saturation={"limit": 0.03}))
    assert stopping.facts.deceleration_rad_s2 == pytest.approx(0.8 * (0.03 + 0.005) / 0.0011)
    assert stopping.facts.speed_rad_s < 3.0, "narrowed until it rests in 60 ms"
    falls = {"gravity": {"amplitude": 0.06, "phase": 1.57}}
    with pytest.raises(BadInput, match=r"a load of 0\.06 N"):
        stated(modelled(tmp_path, torque_saturation={"limit": 0.03}, **falls))


@pytest.mark.parametrize(
    ("effect", "late_s"),
    [
        ({"delay": {"additional_s": 0.01}}, 0.01),
        ({"delay_s": 0.005}, 0.004),
        ({"actuator_lag": {"time_constant_s": 0.015}}, 0.015),
        ({"actuator_lag": {"slew_per_s": 40.0}}, 0.015),
    ],
)
def test_torque_that_comes_late_goes_late(effect: dict[str, Any], late_s: float, tmp_path: Path) -> None:
    plain, late = stated(modelled(tmp_path)), stated(modelled(tmp_path, {"within_s": 0.2}, **effect))
    assert late.facts.hold_s - plain.facts.hold_s == pytest.approx(late_s)
    assert late.facts.lag_s == pytest.approx(max(0.006, late_s))
    assert any("ms late by the model" in note for note in late.notes) is (late_s > 0.006)


def test_what_no_figure_knows_of_a_model_is_said(tmp_path: Path) -> None:
    quadratic = {"viscous_nonlinear": {"quadratic": 0.001}}
    assert any(
        note.endswith("the model has it: viscous_nonlinear") for note in stated(modelled(tmp_path, **quadratic)).notes
    )
    assert len(stated(modelled(tmp_path)).notes) == 1


@pytest.mark.parametrize(
    ("key", "better", "worse"),
    [
        ("least_inertia", 0.002, 0.0005),
        ("most_inertia", 0.00095, 0.003),
        ("least_friction_nm", 0.2, 0.001),
        ("load_max_nm", 0.01, 0.08),
    ],
)
def test_a_joint_that_is_stated_better_than_its_model_is_told_of(
    key: str, better: float, worse: float, tmp_path: Path
) -> None:
    for value, told in ((better, True), (worse, False)):
        config = modelled(tmp_path, {key: value}, gravity={"amplitude": 0.06, "phase": 0.0})
        assert config.model is not None
        lines = weakened(config, load_axis_model(config.model))
        assert any(line.startswith(f"stopping.{key}") for line in lines) is told
        joint = joint_of(config)
        assert joint is not None and joint.source.endswith("but for what the section stopping states")


def test_a_loop_without_its_supervisor_lets_a_law_run_away_until_its_ramp_is_over(tmp_path: Path) -> None:
    """The drive's own reaction does not come into it: the way is that of the loop, and of the ramp behind it."""
    config = modelled(tmp_path, {"within_s": 0.2})
    long, short = (
        stated(config.model_copy(update={"limits": config.limits.model_copy(update={"ramp_down_s": ramp_s})}))
        for ramp_s in (0.09, 0.01)
    )
    way_rad = 3.0 * 0.093 + 3.6 * (0.006 + 0.5 * 3.6 / long.facts.deceleration_rad_s2)
    assert long.travel_rad == pytest.approx(way_rad, abs=1e-4)
    assert short.travel_rad < long.travel_rad
    drive_s = short.time_s - short.facts.hold_s  # the drive's part, where its own reaction is the longest of all
    assert long.time_s == pytest.approx(max(2.0 * long.ramp_down_s, long.ramp_down_s + drive_s) + 0.003)


def test_the_ramp_of_a_loop_alone_leaves_the_drive_its_time() -> None:
    """Both within the time that is asked for: braking by the loop, then the stop of the drive."""
    heavy = stated(axis({"least_inertia": 0.02, "least_friction_nm": 0.01}))
    drive_s = heavy.facts.speed_rad_s * 1.2 / heavy.facts.deceleration_rad_s2 + 2.0 * heavy.facts.lag_s
    assert heavy.ramp_down_s + 0.003 + drive_s <= 0.06 + 1e-6
    assert heavy.time_s == pytest.approx(0.06, rel=1e-3)


@pytest.mark.parametrize(("gear_ratio", "later_s"), [(0.4, 0.0), (1.0, 0.0), (10.0, 0.0166), (1000.0, 0.0497)])
def test_rest_that_the_drive_sees_late_behind_a_gear_is_in_the_time(gear_ratio: float, later_s: float) -> None:
    """The torque holds the joint meanwhile, which rests: no speed is narrowed for it."""
    plain, geared = (stated(axis(LIGHT, amplifier={"gear_ratio": gear})) for gear in (1.0, gear_ratio))
    assert geared.time_s - plain.time_s == pytest.approx(later_s, abs=1e-4)
    assert geared.held_s == pytest.approx(later_s, abs=1e-4)
    assert geared.facts.speed_rad_s == plain.facts.speed_rad_s


def test_a_joint_with_next_to_no_friction_creeps_on_behind_the_ramp() -> None:
    """From what the drive takes for rest; with more friction next to nothing."""
    own = {"least_inertia": 0.006, "most_inertia": 0.006}
    for friction_nm, creeps_rad in ((3e-5, 0.0144), (0.01, 4.3e-5)):
        found = stated(axis({**own, "least_friction_nm": friction_nm}))
        facts = found.facts
        powered_rad = max(way.travel_rad(facts.speed_rad_s, found.speed_rad_s) for way in both_ways(facts))
        alone_rad = facts.speed_rad_s * (found.ramp_down_s + 0.003) + max(
            found.speed_rad_s * (facts.lag_s + 0.5 * found.speed_rad_s / way.deceleration_rad_s2)
            for way in both_ways(facts)
        )
        assert found.travel_rad - max(powered_rad, alone_rad) == pytest.approx(creeps_rad, rel=0.02)
