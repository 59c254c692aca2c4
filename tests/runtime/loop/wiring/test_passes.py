"""Right axes are enabled, whatever their friction, inertia, load, encoder and delay, within the stated bounds."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.formats.model.axis_model import AxisModel, axis_model_yaml, load_axis_model
from servod.formats.wiring import warnings, with_expected
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, ReferenceKind, Refusal
from servod.runtime.loop.wiring.findings import WiringOutcome, wiring_sentence
from tests.runtime.loop.wiring.rig import axis, enable, joint, proven

SHIPPED = ("demo_joint", "table1_joint")
MOST_S, MOST_LEFT_RAD = 0.6, 5e-4


@pytest.mark.parametrize("name", SHIPPED)
def test_the_shipped_joints_are_proven_quickly_and_left_where_they_were(name):
    outcome = proven(load_axis_model(shipped(f"gains/axes/{name}.yaml")))
    assert outcome.enabled, wiring_sentence(outcome.proof)
    assert outcome.proof.duration_s < MOST_S
    assert outcome.furthest_rad < 0.005
    assert abs(outcome.session.world.truth().position_rad) < MOST_LEFT_RAD
    assert outcome.session.cycle.axis.latched == 0
    assert outcome.proof.friction_nm == pytest.approx(0.07, rel=0.25)
    assert outcome.proof.amplifier_per_encoder == pytest.approx(1.0, abs=0.02)
    assert outcome.proof.actual_per_demand == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    "changes",
    [
        {"backlash": {"gap": 0.003, "load_inertia": 0.0005, "stiffness": 200.0, "damping": 0.02}},
        {"joint_elasticity": {"load_inertia": 0.0005, "stiffness": 50.0, "damping": 0.005}},
        {"friction": {"kind": "coulomb_viscous", "coulomb": 0.045, "viscous": 0.056}},
        {"friction": {"kind": "stribeck", "coulomb": 0.045, "static": 0.07, "stribeck_velocity": 0.1}},
        {"torque_offset": 0.03},
        {"spring": {"stiffness": 1.0}},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_slack_springs_and_other_laws_of_friction_are_no_wrong_wiring(changes):
    outcome = proven(joint(**changes))
    assert outcome.enabled, wiring_sentence(outcome.proof)


@st.composite
def plants(draw) -> AxisModel:
    """Joints as they are built, with their noise; every load is one that friction holds, also once the joint slips."""
    coulomb = 10.0 ** draw(st.floats(-2.0, math.log10(0.2)))
    static = coulomb * draw(st.floats(1.0, 1.6))
    size = static / 0.07
    load = draw(st.sampled_from([0.0, 0.3, 0.8])) * coulomb
    friction = {
        "kind": "lugre",
        "sigma0": 950.0 * size * draw(st.floats(0.3, 3.0)),
        "sigma1": size * draw(st.floats(0.3, 1.0)),
        "viscous": 0.056 * size * draw(st.floats(0.05, 1.0)),
        "coulomb": coulomb,
        "static": static,
        "stribeck_velocity": draw(st.floats(0.03, 0.2)),
    }
    return joint(
        inertia=10.0 ** draw(st.floats(math.log10(2e-4), -2.0)),
        delay_s=1e-3 * draw(st.integers(1, 4)),
        friction=friction,
        gravity={"amplitude": load, "phase": draw(st.sampled_from([1.57, -1.57]))},
        noise={"torque_rms": 3e-4 * size, "torque_bandwidth_hz": 200.0, "encoder_rms": 2e-6},
    )


MANY = settings(max_examples=6, suppress_health_check=[HealthCheck.too_slow], derandomize=True)


@MANY
@given(plants(), st.integers(13, 20))
def test_every_plausible_axis_is_enabled_within_the_bounds(plant, bits):
    outcome = proven(plant, encoder_counts_per_turn=2**bits)
    assert outcome.enabled, wiring_sentence(outcome.proof)
    count_rad = 2.0 * math.pi / 2**bits
    assert outcome.furthest_rad < max(0.05, 100.0 * count_rad) + count_rad
    assert outcome.fastest_rad_s < 9.0
    assert outcome.proof.friction_nm > 0.6 * plant.friction.coulomb


WRONG = [
    ({}, {"polarity": 0x20}, {WiringOutcome.TORQUE_POLARITY}),
    ({}, {"encoder_direction": -1}, {WiringOutcome.ENCODER_DIRECTION}),
    ({"amplifier": {"position_direction": -1}}, {}, {WiringOutcome.AMPLIFIER_DIRECTION}),
    ({}, {"gear_ratio": 10.0}, {WiringOutcome.POSITION_SCALE}),
    ({"amplifier": {"counts_per_turn": 2**17}}, {}, {WiringOutcome.POSITION_SCALE}),
]


@MANY
@given(plants(), st.integers(13, 20), st.sampled_from(WRONG))
def test_every_plausible_axis_that_is_wired_wrongly_is_refused_by_name(plant, bits, wrong):
    config, devices, findings = wrong
    outcome = proven(plant, config, encoder_counts_per_turn=2**bits, **devices)
    assert outcome.finding in findings, wiring_sentence(outcome.proof)
    assert outcome.session.cycle.axis.state == AxisState.FAULT
    assert outcome.session.world.truth().torque_nm == 0.0


def test_once_proven_it_is_enabled_at_once_and_proven_again_when_asked():
    session = axis(joint())
    first = enable(session)
    assert session.send(Op.ENABLE, [0, 1]) == Refusal.PROVES_ONLY_FROM_OFF
    session.send(Op.DISABLE)
    session.run(0.3)
    before_ns = session.clock.now_ns()
    session.enable()
    assert session.clock.now_ns() - before_ns < 100_000_000
    session.send(Op.DISABLE)
    session.run(0.3)
    again = enable(session, 0.0, 1.0)
    assert again.enabled
    assert again.proof is not first.proof


@pytest.mark.parametrize("code", [FaultCode.ENCODER_IMPLAUSIBLE, FaultCode.FOLLOWING_ERROR])
def test_a_jump_between_the_sensors_or_a_lost_reference_makes_it_doubtful_again(code):
    session = axis(joint())
    enable(session)
    session.cycle.axis.note(FAULTS[code].bit)
    session.send(Op.DISABLE)
    session.run(0.3)
    before = session.proof
    assert enable(session, 1.0).enabled
    assert session.proof is not before


def test_nothing_else_moves_the_axis_meanwhile_and_disable_ends_the_test():
    session = axis(joint())
    assert session.send(Op.ENABLE) == Refusal.DONE
    session.run(0.1)
    assert session.cycle.axis.state == AxisState.PROVING
    assert session.send(Op.REFERENCE, [ReferenceKind.STEP, 0.1, 1.0]) == Refusal.NOT_ENABLED
    assert session.send(Op.ENABLE) == Refusal.DONE
    assert session.cycle.axis.state == AxisState.PROVING
    session.send(Op.DISABLE)
    session.run(0.01)
    assert session.cycle.axis.state == AxisState.DISABLED
    assert session.proof is not None and session.proof.finding == WiringOutcome.INTERRUPTED
    assert session.world.truth().torque_nm == 0.0
    session.run(0.1)
    assert enable(session).enabled


def test_the_axis_model_says_what_to_expect(tmp_path):
    model = tmp_path / "model.yaml"
    model.write_text(axis_model_yaml(joint()))
    session = axis(joint(), {"model": str(model)})
    assert warnings(with_expected(session.config)) == []
    assert session.config.wiring_proof.friction_nm == 0.07
    assert session.config.wiring_proof.inertia == 0.001
    assert enable(session).enabled


def test_a_switched_off_test_is_not_run_but_when_asked_for():
    session = axis(joint(), {"wiring_proof": {"enabled": False}})
    assert "the first torque comes untested" in warnings(session.config)[0]
    assert "judge the scale" in warnings(axis(joint()).config)[0]
    session.enable()
    assert session.proof is None
    session.send(Op.DISABLE)
    session.run(0.3)
    assert enable(session, 0.0, 1.0).enabled
