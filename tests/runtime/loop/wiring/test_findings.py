"""Each wrong wiring, scale or joint is told by its own name, the axis is off afterwards, and hardly anything moved."""

from __future__ import annotations

import math

import pytest

from servod.client.stepped import SteppedSession
from servod.client.virtual import rated_torque_mnm
from servod.common.faults import FAULTS, FaultCode
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, Refusal
from servod.runtime.loop.wiring.findings import FINDINGS, WiringOutcome, wiring_document, wiring_sentence
from tests.runtime.loop.wiring.rig import Outcome, axis, enable, joint, proven, stronger

JOINT = joint()
RATED_MNM = rated_torque_mnm(JOINT)
KNOWN = {"wiring_proof": {"friction_nm": 0.07, "inertia": 0.001}}
FREE = {"kind": "coulomb_viscous", "coulomb": 1e-5, "viscous": 1e-4}
FREE_AXIS = {"limits": {"torque_nm": 0.3, "torque_rate_nm_per_s": 300.0}}
FREE_STATED = FREE_AXIS | {"wiring_proof": {"friction_nm": 0.0, "inertia": 0.001}}
BLOCKED = joint(friction={"kind": "lugre", "sigma0": 1e5, "sigma1": 10.0, "coulomb": 45.0, "static": 70.0})
MOST_TRAVEL_RAD, MOST_SPEED_RAD_S = 0.05, 3.0

#: Joint, configuration, what the devices really are, and the name under which it must be refused.
WRONG = {
    "polarity of the torque": (JOINT, {}, {"polarity": 0x20}, WiringOutcome.TORQUE_POLARITY),
    "torque direction": (JOINT, {"amplifier": {"torque_direction": -1}}, {}, WiringOutcome.TORQUE_POLARITY),
    "encoder mounted the other way": (JOINT, {}, {"encoder_direction": -1}, WiringOutcome.ENCODER_DIRECTION),
    "encoder direction": (JOINT, {"encoder": {"direction": -1}}, {}, WiringOutcome.ENCODER_DIRECTION),
    "polarity of the position": (JOINT, {}, {"polarity": 0x80}, WiringOutcome.AMPLIFIER_DIRECTION),
    "position direction": (JOINT, {"amplifier": {"position_direction": -1}}, {}, WiringOutcome.AMPLIFIER_DIRECTION),
    "both polarities": (JOINT, {}, {"polarity": 0xA0}, WiringOutcome.ENCODER_DIRECTION),
    "gear of 10 that nobody stated": (JOINT, {}, {"gear_ratio": 10.0}, WiringOutcome.POSITION_SCALE),
    "gear of 10 that is not there": (JOINT, {"amplifier": {"gear_ratio": 10.0}}, {}, WiringOutcome.NO_MOTION),
    "gear of 0.1 that is not there": (JOINT, {"amplifier": {"gear_ratio": 0.1}}, {}, WiringOutcome.RATED_TORQUE),
    "gear off by 1.5": (JOINT, {"amplifier": {"gear_ratio": 1.5}}, {}, WiringOutcome.POSITION_SCALE),
    "motor counts": (JOINT, {"amplifier": {"counts_per_turn": 2**17}}, {}, WiringOutcome.POSITION_SCALE),
    "rated torque in uN*m": (JOINT, {}, {"rated_torque_mnm": 1000 * RATED_MNM}, WiringOutcome.RATED_TORQUE),
    "rated torque in N*m": (JOINT, {}, {"rated_torque_mnm": 1}, WiringOutcome.RATED_TORQUE),
    "a thousand times the torque": (stronger(1000.0), {}, {"bought_for": JOINT}, WiringOutcome.TOO_EASY),
    "a hundred times the torque": (stronger(100.0), {}, {"bought_for": JOINT}, WiringOutcome.TOO_EASY),
    "ten times, where friction is known": (stronger(10.0), KNOWN, {"bought_for": JOINT}, WiringOutcome.TOO_EASY),
    "a tenth of the torque": (stronger(0.1), {}, {"bought_for": JOINT}, WiringOutcome.NO_MOTION),
    "a thousandth of the torque": (stronger(1e-3), {}, {"bought_for": JOINT}, WiringOutcome.NO_MOTION),
    "blocked": (BLOCKED, FREE_AXIS, {"bought_for": JOINT}, WiringOutcome.NO_MOTION),
    **{
        f"closed brake that yields, {stiffness:g} N*m/rad": (
            joint(friction={"kind": "lugre", "sigma0": stiffness, "sigma1": 1.0, "coulomb": 45.0, "static": 70.0}),
            {},
            {"bought_for": JOINT},
            WiringOutcome.NO_MOTION,
        )
        for stiffness in (300.0, 400.0, 450.0, 950.0)
    },
    "drive limits the torque": (JOINT, {}, {"max_torque_permille": 200}, WiringOutcome.TORQUE_ACTUAL),
    "free, and nobody said so": (joint(friction=FREE), FREE_AXIS, {"bought_for": JOINT}, WiringOutcome.TOO_EASY),
    "gravity and polarity": (
        joint(gravity={"amplitude": 0.05, "phase": 1.57}),
        {},
        {"polarity": 0x20},
        WiringOutcome.TORQUE_POLARITY,
    ),
    "coarse encoder and polarity": (
        JOINT,
        {},
        {"encoder_counts_per_turn": 2**13, "polarity": 0x20},
        WiringOutcome.TORQUE_POLARITY,
    ),
}


def refused(outcome: Outcome) -> None:
    """Off, no torque, and the fault that says so."""
    session = outcome.session
    assert session.cycle.axis.state == AxisState.FAULT
    assert session.world.truth().torque_nm == 0.0
    assert session.cycle.axis.latched & FAULTS[FaultCode.WIRING_NOT_PROVEN].bit
    assert outcome.finding.name in session.why


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_told_by_its_name(name):
    plant, config, devices, finding = WRONG[name]
    outcome = proven(plant, config, **devices)
    assert outcome.finding == finding, wiring_sentence(outcome.proof)
    refused(outcome)
    assert outcome.furthest_rad < MOST_TRAVEL_RAD
    assert outcome.fastest_rad_s < MOST_SPEED_RAD_S


def test_a_free_joint_that_is_known_to_be_free_is_enabled_and_its_torque_is_judged_by_its_inertia():
    free = joint(friction=FREE)
    assert proven(free, FREE_STATED, bought_for=JOINT).enabled
    strong = joint(inertia=1e-6, friction={"kind": "coulomb_viscous", "coulomb": 1e-8, "viscous": 1e-7})
    outcome = proven(strong, FREE_STATED, bought_for=JOINT)
    assert outcome.finding == WiringOutcome.TOO_FAST
    refused(outcome)
    weak = joint(inertia=1.0, friction={"kind": "coulomb_viscous", "coulomb": 1e-4, "viscous": 1e-4})
    assert proven(weak, FREE_STATED, bought_for=JOINT).finding == WiringOutcome.TOO_HEAVY


def shows(session: SteppedSession, offset_nm: float) -> SteppedSession:
    """The drive's 0x6077 has this offset."""
    amplifier = session.cycle.amplifier
    truth = amplifier.read
    amplifier.read = lambda: (seen := truth())._replace(torque_nm=seen.torque_nm + offset_nm)
    return session


@pytest.mark.parametrize("rate", [300.0, 20.0, 2.0])
@pytest.mark.parametrize("offset_nm", [0.2, -0.03])
def test_a_torque_that_is_shown_at_rest_is_named_before_any_goes_out(rate, offset_nm):
    config = {"limits": {"torque_rate_nm_per_s": rate, "torque_nm": 0.3}}
    outcome = enable(shows(axis(JOINT, config), offset_nm))
    assert outcome.finding == WiringOutcome.TORQUE_AT_REST, wiring_sentence(outcome.proof)
    refused(outcome)
    assert outcome.furthest_rad < 1e-5
    assert {record.torque_nm for record in outcome.session.records} == {0.0}


def test_a_small_torque_at_rest_passes_and_never_goes_out():
    session = shows(axis(JOINT), 0.005)
    assert enable(session, watch_s=0.01).enabled
    assert {record.torque_nm for record in session.records if record.axis_state == AxisState.ENABLED} == {0.0}


def test_a_torque_that_is_shown_at_a_later_enable_never_goes_out_and_asks_for_the_test_again():
    """The wiring was proven, then the drive's 0x6077 went wrong: what it shows was told for its own torque once."""
    session = axis(JOINT)
    assert enable(session).enabled
    session.send(Op.DISABLE)
    session.run(0.5)
    session.clear()
    shows(session, 0.28)
    seen = enable(session, watch_s=0.2)
    assert {record.torque_nm for record in session.records} == {0.0}
    assert seen.furthest_rad < 1e-4
    assert session.cycle.axis.latched & FAULTS[FaultCode.TORQUE_IMPLAUSIBLE].bit
    assert session.send(Op.ENABLE, [1.0]) == Refusal.DONE
    session.run(0.5)
    assert AxisState.PROVING in {record.axis_state for record in session.records}


def test_a_record_tells_the_torque_that_was_sent():
    """In the cycle in which a proof fails, its last torque is not sent any more."""
    session = proven(JOINT, {"limits": {"torque_rate_nm_per_s": 2.0}}, polarity=0x20).session
    failed = next(record for record in session.records if record.axis_state == AxisState.FAULT)
    assert failed.torque_nm == 0.0


@pytest.mark.parametrize("phase", [1.57, -1.57])
def test_a_load_that_friction_does_not_hold_is_said_so(phase):
    outcome = proven(joint(gravity={"amplitude": 0.09, "phase": phase}), bought_for=JOINT)
    assert outcome.finding == WiringOutcome.NOT_AT_REST
    refused(outcome)


@pytest.mark.parametrize("stiffness", [950.0, 150.0])
@pytest.mark.parametrize("phase", [1.57, -1.57])
def test_a_joint_at_a_stop_is_told_from_a_blocked_one(stiffness, phase):
    """A load that the torque cannot lift stands for the stop, and yields like one; its way back is no motion."""
    config = {"wiring_proof": {"torque_nm": 0.08}}
    friction = {"kind": "lugre", "sigma0": stiffness, "sigma1": 1.0, "coulomb": 0.045, "static": 0.07}
    plant = joint(friction=friction, gravity={"amplitude": 0.05, "phase": phase})
    outcome = proven(plant, config, bought_for=JOINT)
    assert outcome.finding == WiringOutcome.ONE_WAY
    refused(outcome)


def test_a_refused_axis_stays_refused_until_the_test_is_passed():
    session = axis(JOINT, polarity=0x20)
    refused(enable(session, watch_s=0.1))
    assert session.send(Op.ENABLE, [0]) == Refusal.FAULT_PRESENT
    refused(enable(session, 1.0, watch_s=0.1))
    session.master.sdo(1).write(0x607E, 0, 0)
    assert enable(session, 1.0).enabled


def test_bounds_of_travel_and_speed_end_the_test():
    swift = joint(inertia=2e-4, delay_s=0.004)
    too_far = proven(swift, {"wiring_proof": {"most_travel_rad": 0.003}})
    assert too_far.finding == WiringOutcome.TRAVEL
    refused(too_far)
    too_fast = proven(JOINT, {"wiring_proof": {"speed_rad_s": 0.1}})
    assert too_fast.finding == WiringOutcome.SPEED
    refused(too_fast)


@pytest.mark.parametrize(
    ("torque_nm", "plant", "most_rad", "most_s"),
    [
        (0.05, JOINT, 0.01, 6.0),
        (0.2, joint(friction={"kind": "coulomb_viscous", "coulomb": 0.045, "viscous": 0.3}), 0.12, 1.0),
    ],
    ids=["for ever", "too far"],
)
def test_what_the_test_does_not_end_the_axis_and_its_limits_do(torque_nm, plant, most_rad, most_s):
    """A test that has lost its bounds: its torque neither ends nor heeds how far the joint is."""
    session = axis(plant)
    session.run(0.01)
    start_rad = session.world.truth().position_rad
    assert session.send(Op.ENABLE) == Refusal.DONE
    session.run(0.05)
    assert session.cycle.axis.state == AxisState.PROVING
    session.cycle.proof.step = lambda *_: torque_nm
    session.run(most_s)
    assert session.cycle.axis.state == AxisState.FAULT
    assert session.cycle.axis.latched & FAULTS[FaultCode.WIRING_NOT_PROVEN].bit
    assert session.world.truth().torque_nm == 0.0
    assert abs(session.world.truth().position_rad - start_rad) < most_rad
    assert session.proof is not None and session.proof.finding == WiringOutcome.INTERRUPTED


@pytest.mark.parametrize("factor", [1.0, 3.0, 10.0, 40.0])
def test_a_proof_says_how_sharply_it_has_judged_the_scale_of_the_torque(factor):
    """Where nothing is stated a joint on a far too strong drive may be a lighter joint: the sentence says so."""
    blunt = proven(stronger(factor), bought_for=JOINT)
    assert blunt.enabled
    assert blunt.proof.scale_factor > 100.0
    told = wiring_document(blunt.proof)
    assert "only to within a factor of 1.8e+02: state wiring_proof.friction_nm" in told["text"]
    assert (told["expected_nm"], told["scale_factor"]) == (None, pytest.approx(180.0))
    sharp = proven(stronger(factor), KNOWN, bought_for=JOINT)
    assert sharp.enabled is (factor < 5.0)
    assert sharp.proof.scale_factor < 6.0
    assert "only" not in wiring_sentence(sharp.proof)


def test_no_more_torque_is_used_than_the_joint_can_need():
    """A blocked joint on a strong drive feels no more than that."""
    limits = {"limits": {"torque_nm": 30.0, "torque_rate_nm_per_s": 30000.0}}
    heavy = {
        "stopping": {"least_inertia": 1.0, "most_inertia": 1.0, "within_s": 10.0}
    }  # any torque may be had for long
    stated = axis(BLOCKED, limits | KNOWN | heavy, rated_torque_mnm=30000)
    assert enable(stated).finding == WiringOutcome.NO_MOTION
    most_nm = 15.0 * (0.07 + 0.001 * 0.001 * (math.log(1000.0) / 0.2) ** 2) + 0.075 * 30.0
    assert max(abs(row.torque_nm) for row in stated.records) == pytest.approx(most_nm, rel=0.01)


@pytest.mark.parametrize(
    "plant", [BLOCKED, joint(gravity={"amplitude": 0.05, "phase": 1.57})], ids=["blocked", "one way"]
)
def test_the_torque_that_is_named_is_the_one_that_went_out(plant):
    """The way to rest of a light joint narrows it, when the drive goes on by itself for 100 ms."""
    light = {"least_inertia": 1e-3, "most_inertia": 1e-3, "least_friction_nm": 0.04}
    narrow = {"limits": {"torque_nm": 0.3, "speed_rad_s": 3.0}, "heartbeat": {"command_deadline_ms": 0}}
    session = axis(plant, narrow | {"stopping": light}, bought_for=JOINT)
    assert enable(session).finding in (WiringOutcome.NO_MOTION, WiringOutcome.ONE_WAY)
    most_nm = max(abs(row.torque_nm) for row in session.records)
    assert most_nm < 0.5 * 0.3
    assert session.proof.found == pytest.approx(most_nm, rel=0.02)


def test_every_finding_has_a_sentence_and_a_remedy_and_a_document_without_nan():
    proof = proven(JOINT).proof
    for finding in WiringOutcome:
        told = wiring_document(
            proof._replace(finding=finding, found=0.5, lowest=0.0, highest=1.0, negative_nm=math.nan)
        )
        assert told["finding"] == finding.name
        assert told["negative_nm"] is None and told["friction_nm"] is None
        assert (finding in FINDINGS) != told["passed"]
        assert "nan" not in told["text"]


@pytest.mark.parametrize(
    ("finding", "one", "other"),
    [
        (
            WiringOutcome.ENCODER_DIRECTION,
            "encoder.direction",
            "amplifier.torque_direction and amplifier.position_direction",
        ),
        (
            WiringOutcome.AMPLIFIER_DIRECTION,
            "amplifier.position_direction",
            "encoder.direction and amplifier.torque_direction",
        ),
    ],
)
def test_sensors_that_disagree_are_told_with_both_remedies_and_how_to_choose(
    finding: WiringOutcome, one: str, other: str
) -> None:
    remedy = FINDINGS[finding].remedy
    assert "by hand" in remedy and "that shall be positive" in remedy
    assert f"turn round {one};" in remedy and f"turn round both {other}" in remedy
