"""Every limit at its value, one step of the number format to both sides of it, and for numbers that are none.

`scripts/mutate.py limits` shows that each of these lines is needed.
"""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from servod.common.faults import FAULTS, FaultCode
from servod.runtime.loop.limits import Limits
from tests.runtime.loop.boundary.feedback import CONFIG, INF, NAN, NOT_FINITE, above, amplifier, below, encoder

DT_S = 2.0**-10
STEP_NM = 64.0 * DT_S
BIT = {code: fault.bit for code, fault in FAULTS.items()}


def armed(torque_nm: float = 0.0) -> Limits:
    limits = Limits(CONFIG)
    limits.arm(amplifier(), encoder(), torque_nm)
    return limits


def motion(
    position: float = 0.0, velocity: float = 0.0, motor: float | None = None, reference: float | None = None
) -> int:
    """Faults of a motion; motor and reference follow the joint unless they are given."""
    amp = amplifier(position_rad=position if motor is None else motor)
    return armed().motion_faults(
        amp, encoder(position_rad=position, velocity_rad_s=velocity), position if reference is None else reference
    )


# --- the motion -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("limit", "code", "key"),
    [
        (4.0, FaultCode.SPEED_LIMIT, "velocity"),
        (0.25, FaultCode.FOLLOWING_ERROR, "reference"),
        (0.125, FaultCode.ENCODER_IMPLAUSIBLE, "motor"),
    ],
)
def test_symmetric_limit_holds_to_the_last_bit(limit: float, code: FaultCode, key: str, sign: float) -> None:
    for value in (0.0, -0.0, below(limit), limit):
        assert motion(**{key: sign * value}) == 0
    for value in (above(limit), 1e300, INF, NAN):
        assert motion(**{key: sign * value}) == BIT[code]


def test_range_of_positions_holds_to_the_last_bit() -> None:
    for position in (-1.0, below(-1.0), 0.0, -0.0, below(2.0), 2.0):
        assert motion(position) == 0
    for position in (above(-1.0), above(2.0), -1e300, 1e300):
        assert motion(position) == BIT[FaultCode.POSITION_LIMIT]
    for position in NOT_FINITE:
        assert motion(position) & BIT[FaultCode.POSITION_LIMIT]


def test_each_fault_of_the_motion_comes_beside_the_others() -> None:
    limits = armed()
    found = limits.motion_faults(amplifier(position_rad=3.5), encoder(position_rad=3.0, velocity_rad_s=-5.0), 2.0)
    of_motion = ("SPEED_LIMIT", "POSITION_LIMIT", "FOLLOWING_ERROR", "ENCODER_IMPLAUSIBLE")
    assert found == sum(BIT[FaultCode[name]] for name in of_motion)


def test_reference_that_is_followed_no_more_is_not_compared() -> None:
    assert armed().motion_faults(amplifier(position_rad=1.0), encoder(position_rad=1.0), None) == 0


def test_what_the_sensors_differ_by_at_enable_belongs_to_them() -> None:
    limits = Limits(CONFIG)
    assert limits.motion_faults(amplifier(position_rad=0.125), encoder(), 0.0) == 0, "zero before the first enable"
    limits.arm(amplifier(position_rad=5.0), encoder(position_rad=1.0), 0.0)
    for motor, fault in ((5.125, 0), (4.875, 0), (5.25, 1), (4.75, 1), (1.0, 1)):
        found = limits.motion_faults(amplifier(position_rad=motor), encoder(position_rad=1.0), 1.0)
        assert found == fault * BIT[FaultCode.ENCODER_IMPLAUSIBLE]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_joint_that_is_proven_stays_within_twice_the_travel_of_where_it_began(sign: float) -> None:
    limits = Limits(CONFIG)
    assert limits.proving_faults(encoder(position_rad=sign * 0.5), 0.25) == 0, "zero before the first enable"
    for began in (0.0, 8.0, -8.0):  # whole eighths, so that differences are exact
        limits.arm(amplifier(), encoder(position_rad=began), 0.0)
        for travel, fault in ((0.0, 0), (0.375, 0), (0.5, 0), (0.625, 1), (2.0, 1), (9.0, 1), (INF, 1), (NAN, 1)):
            found = limits.proving_faults(encoder(position_rad=began + sign * travel), 0.25)
            assert found == fault * BIT[FaultCode.WIRING_NOT_PROVEN]
    limits.arm(amplifier(), encoder(), 0.0)
    assert limits.proving_faults(encoder(position_rad=sign * above(0.5)), 0.25), "to the last bit"
    assert not limits.proving_faults(encoder(position_rad=sign * 2.0), 1.0), "the travel is the test's own"


# --- feedback and deadline --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("age", "stale"), [(0, False), (2, False), (3, True), (4, True), (1_000_000, True)])
def test_feedback_is_stale_from_the_configured_age_of_either(age: int, stale: bool) -> None:
    expected = BIT[FaultCode.FEEDBACK_STALE] * stale
    assert armed().feedback_faults(amplifier(age_cycles=age), encoder(), 0) == expected
    assert armed().feedback_faults(amplifier(), encoder(age_cycles=age), 0) == expected
    assert armed().feedback_faults(amplifier(age_cycles=age), encoder(age_cycles=age), 0) == expected


@pytest.mark.parametrize("alarms", [1, 2, 1 << 15, 1 << 16])
def test_any_alarm_is_one(alarms: int) -> None:
    assert armed().feedback_faults(amplifier(), encoder(alarms=alarms), 0) == BIT[FaultCode.ENCODER_ALARM]


@pytest.mark.parametrize("bad", NOT_FINITE)
@pytest.mark.parametrize("key", ["position_rad", "torque_nm", "velocity_rad_s", "encoder"])
def test_number_that_is_none_is_a_fault_wherever_it_stands(key: str, bad: float) -> None:
    amp = amplifier(**{key: bad}) if key in ("position_rad", "torque_nm") else amplifier()
    enc = encoder(velocity_rad_s=bad) if key == "velocity_rad_s" else encoder()
    enc = encoder(position_rad=bad) if key == "encoder" else enc
    assert armed().feedback_faults(amp, enc, 0) == BIT[FaultCode.NOT_FINITE]


def test_infinities_of_both_signs_do_not_cancel_and_large_numbers_are_none() -> None:
    limits = armed()
    assert limits.feedback_faults(amplifier(position_rad=INF, torque_nm=-INF), encoder(), 0)
    large = 1e308
    for amp, enc in (
        (amplifier(position_rad=large, torque_nm=-large), encoder()),
        (amplifier(torque_nm=large), encoder(position_rad=-large)),
        (amplifier(), encoder(position_rad=large, velocity_rad_s=-large)),
        (amplifier(position_rad=1e200, torque_nm=1e200), encoder(position_rad=1e200, velocity_rad_s=1e200)),
    ):
        assert limits.feedback_faults(amp, enc, 0) == 0


def test_every_fault_of_feedback_comes_beside_the_others() -> None:
    found = armed().feedback_faults(amplifier(torque_nm=NAN), encoder(age_cycles=3, alarms=1), 5)
    names = ("FEEDBACK_STALE", "ENCODER_ALARM", "NOT_FINITE", "DEADLINE_LATE", "DEADLINE_BUDGET")
    assert found == sum(BIT[FaultCode[name]] for name in names)


def test_skipped_periods_are_counted_and_one_good_cycle_forgives_a_twentieth() -> None:
    late, budget = BIT[FaultCode.DEADLINE_LATE], BIT[FaultCode.DEADLINE_BUDGET]
    limits = armed()

    def skip(periods: int) -> int:
        return limits.feedback_faults(amplifier(), encoder(), periods)

    assert skip(0) == 0
    assert skip(4) == late  # 3.95 of 4
    assert skip(0) == 0  # 3.90
    assert skip(1) == late | budget  # 4.85
    assert skip(0) == budget  # the level stands until it is forgiven
    words = [skip(0) for _ in range(17)]  # 4.75 to 3.95
    assert (words[:15], words[16]) == ([budget] * 15, 0)
    for _ in range(200):
        assert skip(0) == 0
    assert skip(4) == late
    assert skip(1) == late | budget, "two hundred good cycles are no credit"


def test_budget_is_spent_only_when_it_is_exceeded() -> None:
    limits = Limits(CONFIG.model_copy(update={"late_cycles": 0}))
    assert limits.feedback_faults(amplifier(), encoder(), 0) == 0
    assert limits.feedback_faults(amplifier(), encoder(), 1) & BIT[FaultCode.DEADLINE_BUDGET]


# --- the torque -------------------------------------------------------------------------------------------------------
def limited(wanted: float, last: float = 0.0, dt_s: float = DT_S) -> tuple[float, int]:
    return armed(last).limit_torque(wanted, dt_s)


CLIPPED, RATE, NO_NUMBER = (
    BIT[FaultCode[name]] for name in ("TORQUE_CLIPPED", "TORQUE_RATE_CLIPPED", "NOT_FINITE")
)  # fmt: skip


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_is_limited_to_the_last_bit_and_keeps_its_sign(sign: float) -> None:
    slow = 1.0  # a rate that is no matter
    for wanted in (0.0, 2.0**-1074, 0.25, below(0.5), 0.5):
        assert limited(sign * wanted, dt_s=slow) == (sign * wanted, 0)
    for wanted in (above(0.5), 1.0, 63.0):
        assert limited(sign * wanted, dt_s=slow) == (sign * 0.5, CLIPPED)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_change_of_torque_is_limited_to_the_last_bit(sign: float) -> None:
    assert STEP_NM == 0.0625
    for last in (0.0, 0.125, -0.25):
        for change, faults in ((STEP_NM, 0), (0.75 * STEP_NM, 0), (1.25 * STEP_NM, RATE), (0.4, RATE)):
            torque, found = limited(last + sign * change, last)
            assert torque == last + sign * min(change, STEP_NM)
            assert found == faults
    assert limited(sign * above(STEP_NM)) == (sign * STEP_NM, RATE)


def test_torque_has_the_last_word_over_its_rate() -> None:
    assert limited(0.9, last=0.5) == (0.5, RATE | CLIPPED)
    assert limited(0.0, last=0.9) == (0.5, RATE | CLIPPED)
    assert limited(-3.0, last=-0.48, dt_s=1.0) == (-0.5, CLIPPED)


def test_each_torque_starts_from_the_one_that_went_out() -> None:
    limits = armed()
    assert [limits.limit_torque(1.0, DT_S)[0] for _ in range(10)] == [min(0.5, STEP_NM * k) for k in range(1, 11)]
    limits.release()
    assert limits.limit_torque(1.0, DT_S) == (STEP_NM, RATE)


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_no_number_gives_no_torque_and_the_next_ramp_starts_there(bad: float) -> None:
    for wanted, dt_s in ((bad, DT_S), (0.25, bad), (bad, bad)):
        limits = armed(0.25)
        assert limits.limit_torque(wanted, dt_s) == (0.0, NO_NUMBER)
        assert limits.limit_torque(0.25, DT_S) == (STEP_NM, RATE)


def test_before_the_first_enable_the_ramp_starts_from_zero() -> None:
    assert Limits(CONFIG).limit_torque(0.25, DT_S) == (STEP_NM, RATE)


@given(st.floats(-0.5, 0.5), st.lists(st.tuples(st.floats(), st.floats(2.0**-12, 2.0**-8)), max_size=30))
@example(0.5, [(0.0, 0.0007027696755352853), (0.5, 0.0007027696755352853)])  # back by a step that rounding made longer
def test_no_sequence_of_wishes_leaves_the_limits(start: float, wishes: list[tuple[float, float]]) -> None:
    limits, last = armed(start), start
    for wanted, dt_s in wishes:
        torque, faults = limits.limit_torque(wanted, dt_s)
        assert abs(torque) <= 0.5
        assert (torque == wanted) is (faults == 0)
        assert faults & NO_NUMBER or abs(torque - last) <= 64.0 * dt_s + 1e-15
        last = torque


# --- the ramp ---------------------------------------------------------------------------------------------------------
MOVING = 0.01 * 4.0  # a hundredth of the speed limit


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_that_drives_the_joint_on_is_taken_away_at_once(sign: float) -> None:
    limits = armed()
    for velocity in (0.0, -0.0, below(MOVING), MOVING):
        assert limits.ramp(sign * 0.25, 0.5, sign * velocity) == sign * 0.125
    for velocity in (above(MOVING), 1.0, 4.0):
        assert limits.ramp(sign * 0.25, 0.5, sign * velocity) == 0.0
        assert limits.ramp(sign * 0.25, 0.5, -sign * velocity) == sign * 0.125
    assert limits.ramp(0.0, 0.5, sign) == 0.0
    assert limits.ramp(5e-324, 1.0, 0.05) == 5e-324, "too little to drive anything"


@pytest.mark.parametrize(("share", "torque"), [(1.0, 0.25), (0.0, 0.0), (0.25, 0.0625)])
def test_ramp_takes_its_share(share: float, torque: float) -> None:
    assert armed().ramp(0.25, share, 0.0) == torque
    assert math.copysign(1.0, armed().ramp(-0.25, share, -0.01)) == -1.0


@pytest.mark.parametrize(("amp_age", "enc_age", "compared"), [(0, 0, 1), (2, 2, 1), (0, 1, 0), (1, 0, 0)])
def test_positions_are_compared_when_they_are_of_one_moment(amp_age: int, enc_age: int, compared: int) -> None:
    amp, enc = amplifier(position_rad=1.0, age_cycles=amp_age), encoder(age_cycles=enc_age)
    assert armed().motion_faults(amp, enc, 0.0) == compared * BIT[FaultCode.ENCODER_IMPLAUSIBLE]


# --- the torque that the drive says it gives --------------------------------------------------------------------------
BENT = BIT[FaultCode.TORQUE_IMPLAUSIBLE]
MISMATCH = 0.25 * CONFIG.torque_nm


def said(limits: Limits, torque_nm: float, cycles: int, **changes: object) -> list[int]:
    return [limits.torque_faults(amplifier(torque_nm=torque_nm, **changes)) for _ in range(cycles)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_bent_torque_is_a_fault_after_so_many_cycles_in_a_row(sign: float) -> None:
    assert set(said(armed(), sign * MISMATCH, 200)) == {0}, "as far as is allowed"
    limits = armed()
    assert said(limits, sign * above(MISMATCH), 49) == [0] * 49
    assert said(limits, 0.0, 1) == [0]
    assert said(limits, sign * above(MISMATCH), 50) == [0] * 49 + [BENT]


def test_an_old_torque_is_not_judged() -> None:
    assert set(said(armed(), 0.5, 200, age_cycles=1)) == {0}


@pytest.mark.parametrize("commanded_nm", [0.5, -0.5])
def test_a_drive_that_says_it_limits_the_torque_may_give_less_and_never_more(commanded_nm: float) -> None:
    def shown(torque_nm: float) -> set[int]:
        limits, seen = armed(commanded_nm), set()
        for _ in range(200):
            limits.limit_torque(commanded_nm, DT_S)
            seen |= set(said(limits, torque_nm, 1, status_word=0x0A37))
        return seen

    assert shown(0.0) == shown(0.5 * commanded_nm) == shown(commanded_nm) == {0}
    excess_nm = math.copysign(1.01 * MISMATCH, commanded_nm)
    assert shown(commanded_nm + excess_nm) == shown(-excess_nm) == {0, BENT}


def test_the_torque_is_held_against_the_commands_of_the_last_cycles() -> None:
    """A command of full torque is forgotten in twenty cycles, so that what the drive still gives of it is no lie."""
    limits = armed(CONFIG.torque_nm)
    for _ in range(9):
        limits.limit_torque(0.0, 1.0)
    assert set(said(limits, 0.75 * CONFIG.torque_nm, 100)) == {0}
    for _ in range(10):
        limits.limit_torque(0.0, 1.0)
    assert said(limits, 0.75 * CONFIG.torque_nm, 50)[-1] == BENT


def test_the_allowed_distance_can_be_stated() -> None:
    limits = Limits(CONFIG.model_copy(update={"torque_mismatch_nm": 0.0625}))
    limits.arm(amplifier(), encoder(), 0.0)
    assert said(limits, above(0.0625), 50)[-1] == BENT
