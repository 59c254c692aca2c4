"""Reference motions: the paper's trajectory against its formula, derivatives against differences, halting smooth."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servod.kernels.motions import paper, sine
from servod.runtime.loop.commands import ReferenceKind, Refusal
from servod.runtime.loop.references import Motion, Reference, make_motion

PERIOD_S = 1e-3


def test_paper_trajectory_is_equation_19():
    for t in (0.0, 1.0, 7.3, 30.0):
        assert paper(t)[0] == pytest.approx((0.1 - 0.0033 * t) * math.sin(0.2 * math.pi * t))


@given(st.floats(0.01, 30.0))
def test_derivatives_agree_with_differences(t):
    h = 1e-4
    for path in (paper, sine(0.3, 1.7)):
        before, here, after = path(t - h), path(t), path(t + h)
        assert here[1] == pytest.approx((after[0] - before[0]) / (2 * h), abs=1e-4)
        assert here[2] == pytest.approx((after[0] - 2 * here[0] + before[0]) / h**2, abs=1e-2)


def run(reference: Reference, cycles: int) -> list[float]:
    positions = []
    for _ in range(cycles):
        reference.advance(PERIOD_S)
        positions.append(reference.position_rad)
    return positions


def started(kind: ReferenceKind, *arguments: float, trajectory=()) -> Reference:
    motion = make_motion([kind, *arguments], PERIOD_S, trajectory)
    assert isinstance(motion, Motion)
    reference = Reference(0.05)
    reference.hold(1.0)
    reference.start(motion)
    return reference


def test_step_starts_at_the_present_position_and_stays_at_its_end():
    reference = started(ReferenceKind.STEP, 0.1, 0.2)
    assert run(reference, 300)[0] == pytest.approx(1.1)
    assert not reference.active
    assert reference.position_rad == pytest.approx(1.1)


def test_table_is_followed_sample_by_sample():
    rows = [0.5, 0.51, 0.53, 0.52]  # a table is relative to its first sample: no jump at the start
    reference = started(ReferenceKind.TABLE, 4, 0.5, 0.53, trajectory=rows)
    assert run(reference, 3) == pytest.approx([1.01, 1.03, 1.02])
    assert not reference.active


def test_halt_slows_down_without_leaving_the_path_and_goes_on():
    reference = started(ReferenceKind.SINE, 0.1, 0.5, 10.0)
    run(reference, 300)
    speed = reference.velocity_rad_s
    reference.halt(True)
    positions = run(reference, 60)
    assert reference.at_rest
    assert reference.velocity_rad_s == 0.0
    steps = [abs(b - a) for a, b in pairwise(positions)]
    assert all(b <= a + 1e-12 for a, b in pairwise(steps))
    reference.halt(False)
    run(reference, 60)
    assert abs(reference.velocity_rad_s) == pytest.approx(abs(speed), rel=0.3)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        [99],
        [ReferenceKind.SINE, 0.1],
        [ReferenceKind.SINE, 0.1, -1.0, 1.0],
        [ReferenceKind.SINE, math.nan, 1.0, 1.0],
        [ReferenceKind.PAPER, 31.0],
        [ReferenceKind.STEP, 0.1, 0.0],
        [ReferenceKind.TABLE, 5, 0.0, 0.0],
        [ReferenceKind.TABLE, 1, 0.0, 0.0],
    ],
)
def test_bad_arguments_are_refused(arguments):
    assert make_motion(arguments, PERIOD_S, [0.0, 0.0]) == Refusal.BAD_ARGUMENT


EXCITATION = [0.0, 0.0, 0.0, 0.0, 0.01, 0.02, -0.03, 0.04]


def test_an_excitation_holds_each_torque_for_a_period_and_ends_without():
    reference = started(ReferenceKind.EXCITE, 4, 0.0, 0.0, 0.1, trajectory=EXCITATION)
    torques = []
    for _ in range(4):
        reference.advance(PERIOD_S)
        torques.append(reference.torque_nm)
    assert torques == pytest.approx([0.02, -0.03, 0.0, 0.0])
    assert not reference.active


def test_an_excitation_fades_and_ends_when_the_joint_leaves_its_window():
    samples = 100
    reference = started(ReferenceKind.EXCITE, samples, 0.0, 0.0, 0.1, trajectory=[0.0] * samples + [1.0] * samples)
    reference.watch(1.03)
    reference.watch(1.12)
    reference.advance(PERIOD_S)
    assert reference.torque_nm == 1.0
    reference.watch(1.14)
    fading = []
    while reference.active:
        reference.advance(PERIOD_S)
        fading.append(reference.torque_nm)
    assert fading == sorted(fading, reverse=True)
    assert len(fading) < samples
    assert reference.torque_nm == 0.0


@pytest.mark.parametrize("arguments", [(5, 0.0, 0.0, 0.1), (1, 0.0, 0.0, 0.1), (4, 0.0, 0.0, 0.0), (4, 0.0, 0.0)])
def test_an_excitation_must_fit_the_area_and_have_a_window(arguments):
    assert make_motion([ReferenceKind.EXCITE, *arguments], PERIOD_S, EXCITATION) is Refusal.BAD_ARGUMENT


def test_acceleration_while_halting_is_the_derivative_of_the_velocity():
    reference = started(ReferenceKind.SINE, 0.1, 0.5, 10.0)
    run(reference, 300)
    reference.halt(True)
    before = reference.velocity_rad_s
    for _ in range(40):
        reference.advance(PERIOD_S)
        difference = (reference.velocity_rad_s - before) / PERIOD_S
        assert reference.acceleration_rad_s2 == pytest.approx(difference, rel=0.05, abs=0.05)
        before = reference.velocity_rad_s


def test_extent_and_speed_of_a_motion_are_stated_for_the_limits():
    motion = make_motion([ReferenceKind.TABLE, 3, 4.0, 6.0], PERIOD_S, [5.0, 6.0, 4.0])
    assert (motion.lowest_rad, motion.highest_rad) == (-1.0, 1.0)
    assert make_motion([ReferenceKind.SINE, -0.1, 2.0, 1.0], PERIOD_S, []).speed_rad_s == pytest.approx(0.4 * math.pi)
