"""The limits are tested at their boundary, on both sides of it, and by mutation: each check must bite."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.common.faults import FAULTS, FaultCode
from servod.runtime.loop.limits import Limits
from tests.runtime.loop.boundary.feedback import CONFIG as EXACT
from tests.runtime.loop.boundary.feedback import above, amplifier, encoder

CONFIG = EXACT.model_copy(update={"torque_nm": 0.3, "torque_rate_nm_per_s": 100.0, "speed_rad_s": 5.0})
PERIOD_S = 1e-3


def armed() -> Limits:
    limits = Limits(CONFIG)
    limits.arm(amplifier(), encoder())
    return limits


def codes(word: int) -> set[FaultCode]:
    return {c for c, f in FAULTS.items() if word & f.bit}


MOTION = [
    (FaultCode.SPEED_LIMIT, "encoder", {"velocity_rad_s": 5.0}),
    (FaultCode.SPEED_LIMIT, "encoder", {"velocity_rad_s": -5.0}),
    (FaultCode.POSITION_LIMIT, "encoder", {"position_rad": 2.0}),
    (FaultCode.POSITION_LIMIT, "encoder", {"position_rad": -1.0}),
    (FaultCode.FOLLOWING_ERROR, "reference", 0.25),
    (FaultCode.FOLLOWING_ERROR, "reference", -0.25),
    (FaultCode.ENCODER_IMPLAUSIBLE, "amplifier", {"position_rad": 0.125}),
    (FaultCode.ENCODER_IMPLAUSIBLE, "amplifier", {"position_rad": -0.125}),
]


def motion_faults(who: str, what) -> set[FaultCode]:
    amp, enc, reference = amplifier(), encoder(), 0.0
    if who == "reference":
        reference = what
    elif who == "amplifier":
        amp = amplifier(**what)
    else:
        enc = encoder(**what)
        reference = enc.position_rad
        amp = amplifier(position_rad=enc.position_rad)
    return codes(armed().motion_faults(amp, enc, reference))


@pytest.mark.parametrize(("code", "who", "what"), MOTION)
def test_at_the_limit_is_allowed_and_just_beyond_is_not(code, who, what):
    assert motion_faults(who, what) == set()
    beyond = above(what) if isinstance(what, float) else {k: above(v) for k, v in what.items()}
    assert motion_faults(who, beyond) == {code}


@pytest.mark.parametrize("field", ["position_rad", "velocity_rad_s"])
def test_nan_in_the_encoder_is_never_inside_a_limit(field):
    assert armed().motion_faults(amplifier(), encoder(**{field: math.nan}), 0.0) != 0
    assert FaultCode.NOT_FINITE in codes(armed().feedback_faults(amplifier(), encoder(**{field: math.nan}), 0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_not_finite_torque_becomes_zero_and_a_fault(bad):
    torque, faults = armed().limit_torque(bad, PERIOD_S)
    assert torque == 0.0
    assert codes(faults) == {FaultCode.NOT_FINITE}


@pytest.mark.parametrize("age", [2, 3])
@pytest.mark.parametrize("who", ["amplifier", "encoder"])
def test_stale_feedback_counts_from_the_configured_age(who, age):
    amp = amplifier(age_cycles=age if who == "amplifier" else 0)
    enc = encoder(age_cycles=age if who == "encoder" else 0)
    assert codes(armed().feedback_faults(amp, enc, 0)) == ({FaultCode.FEEDBACK_STALE} if age == 3 else set())


def test_encoder_alarm():
    assert codes(armed().feedback_faults(amplifier(), encoder(alarms=1), 0)) == {FaultCode.ENCODER_ALARM}


def test_late_cycles_warn_then_end_the_motion_and_one_good_cycle_does_not_forgive():
    limits = armed()
    assert codes(limits.feedback_faults(amplifier(), encoder(), 4)) == {FaultCode.DEADLINE_LATE}
    assert limits.feedback_faults(amplifier(), encoder(), 0) == 0
    assert codes(limits.feedback_faults(amplifier(), encoder(), 1)) == {
        FaultCode.DEADLINE_LATE,
        FaultCode.DEADLINE_BUDGET,
    }
    for _ in range(100):
        limits.feedback_faults(amplifier(), encoder(), 0)
    assert codes(limits.feedback_faults(amplifier(), encoder(), 4)) == {FaultCode.DEADLINE_LATE}


def test_a_machine_that_is_late_every_other_cycle_does_not_pass():
    limits, found = armed(), set()
    for _ in range(20):
        found |= codes(limits.feedback_faults(amplifier(), encoder(), 2))
        limits.feedback_faults(amplifier(), encoder(), 0)
    assert FaultCode.DEADLINE_BUDGET in found


@pytest.mark.parametrize(
    ("name", "bit"), [("stale_cycles", FaultCode.FEEDBACK_STALE), ("late_cycles", FaultCode.DEADLINE_BUDGET)]
)
def test_mutation_of_the_limits_in_cycles(name, bit):
    wide = Limits(CONFIG.model_copy(update={name: 1000}))
    seen = wide.feedback_faults(amplifier(age_cycles=4), encoder(), 6)
    assert bit not in codes(seen)
    assert bit in codes(armed().feedback_faults(amplifier(age_cycles=4), encoder(), 6))


def test_offset_between_the_sensors_at_enable_is_not_a_mismatch():
    limits = Limits(CONFIG)
    limits.arm(amplifier(position_rad=7.0), encoder(position_rad=0.5))
    assert limits.motion_faults(amplifier(position_rad=7.0), encoder(position_rad=0.5), 0.5) == 0
    assert limits.motion_faults(amplifier(position_rad=7.2), encoder(position_rad=0.5), 0.5) != 0


def test_rate_limit_starts_from_the_torque_at_enable():
    limits = Limits(CONFIG)
    limits.arm(amplifier(torque_nm=0.2), encoder())
    assert limits.limit_torque(0.2, PERIOD_S) == (0.2, 0)
    torque, faults = limits.limit_torque(-0.2, PERIOD_S)
    assert torque == pytest.approx(0.1)
    assert codes(faults) == {FaultCode.TORQUE_RATE_CLIPPED}


@pytest.mark.parametrize("name", ["position_min_rad", "position_max_rad", "torque_rate_nm_per_s"])
def test_mutation_of_range_and_rate(name):
    wide = Limits(CONFIG.model_copy(update={name: getattr(CONFIG, name) * 1000}))
    wide.arm(amplifier(), encoder())

    def seen(limits: Limits) -> set[FaultCode]:
        low, high = encoder(position_rad=-1.5), encoder(position_rad=2.5)
        words = [
            limits.motion_faults(amplifier(position_rad=e.position_rad), e, None) << i
            for i, e in ((0, low), (32, high))
        ]
        return {(i, limits.limit_torque(0.25, PERIOD_S)[1] != 0) for i, w in enumerate(words) if w}

    assert seen(wide) != seen(armed())


@given(st.floats(-10, 10), st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=60))
def test_no_sequence_of_wishes_gets_more_torque_or_rate_than_allowed(start, wishes):
    limits, last = Limits(CONFIG), start
    limits.arm(amplifier(torque_nm=start), encoder())
    for wish in wishes:
        torque, faults = limits.limit_torque(wish, PERIOD_S)
        assert math.isfinite(torque)
        assert abs(torque) <= CONFIG.torque_nm
        if not codes(faults) & {FaultCode.NOT_FINITE} and abs(last) <= CONFIG.torque_nm:
            assert abs(torque - last) <= CONFIG.torque_rate_nm_per_s * PERIOD_S * (1 + 1e-12)
        last = torque


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_ramp_holds_and_brakes_but_never_drives_on(sign):
    limits = armed()
    assert limits.ramp(0.2 * sign, 0.5, -1.0 * sign) == 0.1 * sign
    assert limits.ramp(0.2 * sign, 0.5, 0.0) == 0.1 * sign
    assert limits.ramp(0.2 * sign, 0.5, 1.0 * sign) == 0.0


def test_without_a_reference_only_the_following_error_is_left_out():
    found = codes(
        armed().motion_faults(amplifier(position_rad=9.0), encoder(velocity_rad_s=9.0, position_rad=5.0), None)
    )
    assert found == {FaultCode.SPEED_LIMIT, FaultCode.POSITION_LIMIT, FaultCode.ENCODER_IMPLAUSIBLE}


@pytest.mark.parametrize("name", ["torque_nm", "speed_rad_s", "following_error_rad", "encoder_mismatch_rad"])
def test_mutation_each_limit_is_in_use(name):
    """With one limit made a thousand times wider, the very fault that it guards is no longer found."""

    def everything(limits: Limits) -> int:
        enc = encoder(velocity_rad_s=6.0)
        return limits.motion_faults(amplifier(position_rad=0.2), enc, 0.4) | limits.limit_torque(0.35, 1.0)[1]

    wide = Limits(CONFIG.model_copy(update={name: getattr(CONFIG, name) * 1000}))
    wide.arm(amplifier(), encoder())
    assert everything(wide).bit_count() == everything(armed()).bit_count() - 1
