"""The limits are tested at their boundary, on both sides of it, and by mutation: each check must bite."""

import math
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.common.faults import FAULTS, FaultCode
from servod.kernels.holding import Holding
from servod.kernels.stopping import StopFacts, both_ways
from servod.runtime.fieldbus.devices import AmplifierFeedback, EncoderFeedback
from servod.runtime.loop.limits import Limits
from tests.runtime.loop.boundary.feedback import CONFIG as EXACT
from tests.runtime.loop.boundary.feedback import above, amplifier, encoder

CONFIG = EXACT.model_copy(update={"torque_nm": 0.3, "torque_rate_nm_per_s": 100.0, "speed_rad_s": 5.0})
PERIOD_S = 1e-3


def armed() -> Limits:
    limits = Limits(CONFIG)
    limits.arm(amplifier(), encoder(), 0.0)
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
    limits.arm(amplifier(position_rad=7.0), encoder(position_rad=0.5), 0.0)
    assert limits.motion_faults(amplifier(position_rad=7.0), encoder(position_rad=0.5), 0.5) == 0
    assert limits.motion_faults(amplifier(position_rad=7.2), encoder(position_rad=0.5), 0.5) != 0


def test_rate_limit_starts_from_the_torque_at_enable():
    limits = Limits(CONFIG)
    limits.arm(amplifier(), encoder(), 0.2)
    assert limits.limit_torque(0.2, PERIOD_S) == (0.2, 0)
    torque, faults = limits.limit_torque(-0.2, PERIOD_S)
    assert torque == pytest.approx(0.1)
    assert codes(faults) == {FaultCode.TORQUE_RATE_CLIPPED}


@pytest.mark.parametrize("name", ["position_min_rad", "position_max_rad", "torque_rate_nm_per_s"])
def test_mutation_of_range_and_rate(name):
    wide = Limits(CONFIG.model_copy(update={name: getattr(CONFIG, name) * 1000}))
    wide.arm(amplifier(), encoder(), 0.0)

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
    limits.arm(amplifier(), encoder(), start)
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
    wide.arm(amplifier(), encoder(), 0.0)
    assert everything(wide).bit_count() == everything(armed()).bit_count() - 1


STOP = StopFacts(1e-3, 1e-3, 0.01, 0.0, -0.02, 0.02, 0.3, 5.0, 5.75, -1.0, 2.0, 0.024, 0.006, 200.0)


def looked(amp: AmplifierFeedback, enc: EncoderFeedback) -> Limits:
    limits = Limits(CONFIG, STOP)
    limits.arm(amp, enc, 0.0)
    limits.look(amp, enc, PERIOD_S)
    return limits


def test_torque_towards_the_motion_ends_where_the_joint_could_not_be_stopped():
    """The controller is not trusted: it asks for all there is, either way."""
    for speed_rad_s, most_nm in ((0.0, 0.2295833), (4.0, 0.0629167), (5.75, 0.0), (9.0, 0.0)):
        limits = looked(amplifier(), encoder(velocity_rad_s=speed_rad_s))
        limits._last_torque_nm = 0.3
        torque_nm, faults = limits.limit_torque(0.3, PERIOD_S)
        assert torque_nm == pytest.approx(most_nm, abs=1e-6)
        assert codes(faults) == {FaultCode.TORQUE_CLIPPED}
        limits._last_torque_nm = -0.3
        assert limits.limit_torque(-0.3, PERIOD_S)[0] == pytest.approx(-0.2295833, abs=1e-6)


def test_the_position_limit_acts_where_the_joint_can_still_stop():
    """2 rad/s: 24 ms held, 6 ms of lag, 10 ms of ramp, and a load that pushes."""
    needed_rad = both_ways(STOP)[0].travel_rad(2.0, 2.0 + 0.01 / 1e-3 * 0.024)
    for share, found in ((1.001, set()), (0.999, {FaultCode.POSITION_LIMIT})):
        for speed_rad_s, told in ((2.0, found), (-2.0, set())):
            there = encoder(position_rad=2.0 - share * needed_rad, velocity_rad_s=speed_rad_s)
            motor = amplifier(position_rad=there.position_rad)
            assert codes(looked(motor, there).motion_faults(motor, there, None)) == told


def test_an_encoder_that_stands_still_does_not_hide_the_speed():
    limits = Limits(CONFIG, STOP)
    limits.arm(amplifier(), encoder(), 0.0)
    for number in range(30):
        limits.look(amplifier(position_rad=0.004 * number), encoder(), PERIOD_S)
    limits._last_torque_nm = 0.3
    assert limits.limit_torque(0.3, PERIOD_S)[0] == pytest.approx(0.0629167, abs=1e-5)


def test_a_joint_faster_than_three_hundredths_of_its_speed_limit_is_not_let_go():
    most = 0.03 * CONFIG.speed_rad_s
    limits = Limits(CONFIG)
    for speed, moving in ((0.0, False), (0.99 * most, False), (1.01 * most, True), (-1.01 * most, True)):
        assert limits.moving(encoder(velocity_rad_s=speed)) is moving


@pytest.mark.parametrize(
    ("apart_rad", "speed_rad_s", "told"), [(0.3, 0.0, True), (0.0, 4.0, False), (0.0, -4.0, False)]
)
def test_frames_that_are_never_of_one_moment_hide_no_mismatch(apart_rad: float, speed_rad_s: float, told: bool) -> None:
    """Each node loses every other frame. What a joint moves between two moments is none."""
    limits, seen = Limits(CONFIG), []
    limits.arm(amplifier(), encoder(), 0.0)
    for number in range(100):
        of_drive, of_encoder = (number - number % 2, number - (number + 1) % 2)  # the cycle that each is of
        way_rad = speed_rad_s * PERIOD_S
        amp = amplifier(position_rad=apart_rad + way_rad * of_drive, age_cycles=number - of_drive)
        enc = encoder(position_rad=way_rad * of_encoder, age_cycles=number - of_encoder, velocity_rad_s=speed_rad_s)
        limits.look(amp, enc, PERIOD_S)
        seen.append(FaultCode.ENCODER_IMPLAUSIBLE in codes(limits.motion_faults(amp, enc, None)))
    assert seen == [told and number >= CONFIG.stale_cycles for number in range(100)]


@pytest.mark.parametrize("lost", [1, 4, 15])
def test_frames_that_were_lost_make_the_joint_no_faster(lost: int) -> None:
    """The way since the drive was heard last is that of all cycles meanwhile, not of one."""
    limits = Limits(CONFIG, STOP)
    limits.arm(amplifier(), encoder(), 0.0)
    for number in range(60):
        heard = number % (lost + 1) == 0
        limits.look(amplifier(position_rad=0.002 * number, age_cycles=0 if heard else 1), encoder(), PERIOD_S)
        assert limits._motor_rad_s <= 2.0 + 1e-9
    assert limits._motor_rad_s == pytest.approx(2.0, rel=0.05)


def test_what_was_not_heard_is_reckoned_with_the_last_torque():
    limits = looked(amplifier(), encoder(age_cycles=0))
    limits._last_torque_nm = 0.2
    limits.look(amplifier(age_cycles=10), encoder(age_cycles=10), PERIOD_S)
    assert limits.limit_torque(0.3, PERIOD_S)[0] == pytest.approx(
        0.2295833 - 1e-3 / 0.024 * (0.22 / 1e-3 * 0.01), abs=1e-6
    )


#: A load of 0.4 N*m may hang on it, which pulls down, with a tenth of the inertia to spare.
HANGS = StopFacts(2e-3, 2e-3, 0.01, 0.0, -0.4, 0.0, 0.8, 5.0, 5.75, -1.0, 1.0, 0.024, 0.006, 200.0)


def driven(speed, torque_nm, facts, dt_s):
    """The speed a moment later, with the least inertia and friction."""
    speed += torque_nm / facts.least_inertia * dt_s
    return math.copysign(max(abs(speed) - facts.friction_nm / facts.least_inertia * dt_s, 0.0), speed)


def rests_at(position, speed, torque_nm, facts):
    """Where a joint is furthest if nobody commands it from now on: torque for the reaction, then the drive's ramp."""
    furthest, steps = position, round(facts.hold_s / 2.5e-4)
    for _ in range(steps):
        speed = driven(speed, torque_nm, facts, facts.hold_s / steps)
        position += speed * facts.hold_s / steps
        furthest = max(furthest, position)
    up = max(speed, 0.0)
    return max(furthest, position + up * facts.lag_s + up * up / (2.0 * facts.deceleration_rad_s2))


def moved(load_nm, from_rad, to_rad, enabled_at_nm=0.0, gain=8.0, damping=0.16, facts=HANGS, late=0, cycles=2000):
    """Positions of a joint under a position law and the limits; None at the end: a position limit. In every cycle the
    master may die: the joint rests inside its range."""
    config = CONFIG.model_copy(update={"torque_nm": 0.8, "position_max_rad": 1.0, "torque_rate_nm_per_s": 400.0})
    limits, position, speed, seen = Limits(config, facts), from_rad, 0.0, []
    limits.arm(amplifier(position_rad=position), encoder(position_rad=position), enabled_at_nm)
    commands = deque([enabled_at_nm] * (late + 1), maxlen=late + 1)
    for _ in range(cycles):
        amp, enc = amplifier(position_rad=position), encoder(position_rad=position, velocity_rad_s=speed)
        limits.look(amp, enc, PERIOD_S)
        seen.append(position)
        if codes(limits.motion_faults(amp, enc, None)):
            return [*seen, None]
        wanted_nm = 0.4 + gain * (to_rad - position) - damping * speed
        torque_nm, _ = limits.limit_torque(wanted_nm, PERIOD_S)
        assert rests_at(position, speed, torque_nm - load_nm, facts) < facts.position_max_rad + 5e-4
        commands.append(torque_nm)
        speed = driven(speed, commands[0] - load_nm, facts, PERIOD_S)
        position += speed * PERIOD_S
    return seen


@pytest.mark.parametrize("room_rad", [0.02, 0.002])
def test_a_hanging_load_near_the_end_of_the_range_is_held(room_rad):
    there = 1.0 - room_rad
    held = moved(0.4, there, there, enabled_at_nm=0.4)
    assert min(held) > there - 1e-3 and held[-1] == pytest.approx(there, abs=2e-3)
    positions = moved(0.4, there, there)  # from no torque on: it falls with 200 rad/s^2, is caught and stays
    assert None not in positions and min(positions) > there - 0.15
    assert max(positions[-500:]) - min(positions[-500:]) < 0.03


@pytest.mark.parametrize("load_nm", [0.0, 0.4])
@pytest.mark.parametrize("room_rad", [0.03, 0.01, 0.002])
@pytest.mark.parametrize("to_rad", [0.9, 1.0, 1.2])
def test_near_the_end_of_the_range_the_master_may_die_in_any_cycle(load_nm, room_rad, to_rad):
    """With the load and without, where the law asks for 0.8 N*m: what nothing holds is not granted (`moved`)."""
    positions = moved(load_nm, 1.0 - room_rad, to_rad, cycles=400)
    assert len(positions) > 5


def test_a_cycle_that_was_late_proves_nothing():
    """At an even speed a long cycle looks like a push and a pull."""
    found, position = Holding(HANGS), 0.0
    for number in range(80):
        dt_s = 8e-3 if number == 40 else PERIOD_S
        position += 0.4 * dt_s
        proof = found.look(position, 0.0, dt_s, heard=True)
        assert proof.up_nm == pytest.approx(0.0, abs=1e-9) == proof.down_nm


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    least=st.floats(5e-4, 2e-2),
    heavier=st.floats(1.0, 1.5),
    hold_s=st.floats(0.01, 0.15),
    load_nm=st.floats(0.0, 0.5),
    hangs=st.booleans(),
    room_rad=st.floats(0.001, 0.1),
    late=st.integers(0, 3),
)
def test_the_end_of_the_range_is_kept_by_any_joint(least, heavier, hold_s, load_nm, hangs, room_rad, late):
    """Also with commands that act a few cycles later than they are given, and however heavy the joint may be."""
    facts = HANGS._replace(least_inertia=least, most_inertia=heavier * least, load_min_nm=-load_nm)
    facts = facts._replace(hold_s=hold_s + 1e-3 * late, deceleration_rad_s2=0.2 / (heavier * least))
    moved(load_nm if hangs else 0.0, 1.0 - room_rad, 1.1, facts=facts, late=late, cycles=250)


def test_without_the_load_the_end_of_the_range_is_kept_all_the_same():
    """The law pushes as if the load hung on it; the drive stops the joint inside its range."""
    *positions, end = moved(0.0, 0.0, 1.2, gain=1.0, damping=0.4)
    assert end is None and 0.8 < positions[-1] < 1.0
    speed_rad_s = (positions[-1] - positions[-2]) / PERIOD_S
    assert positions[-1] + both_ways(HANGS)[0].travel_rad(speed_rad_s, speed_rad_s) < 1.01
