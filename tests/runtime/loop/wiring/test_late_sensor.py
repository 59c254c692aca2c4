"""Two sensors never show the same moment: one that is late by some cycles is no sensor of another scale."""

from __future__ import annotations

import math
from collections import deque
from itertools import product

import pytest

from servod.runtime.fieldbus.devices import AmplifierFeedback, DriveState, EncoderFeedback, Reason
from servod.runtime.loop.wiring.checks import wiring_test_bounds
from servod.runtime.loop.wiring.findings import WiringOutcome, WiringReport
from servod.runtime.loop.wiring.wiring_test import WiringTest
from tests.runtime.loop.wiring.rig import axis, joint

PERIOD_S, STEPS = 1e-3, 20
ENABLED = DriveState.OPERATION_ENABLED


class Slider:
    """An inertia with dry and viscous friction, in explicit steps."""

    def __init__(self, inertia: float, dry_nm: float, viscous: float) -> None:
        self.inertia, self.dry_nm, self.viscous = inertia, dry_nm, viscous
        self.position_rad = self.speed_rad_s = 0.0

    def go(self, torque_nm: float) -> None:
        """One period."""
        step_s = PERIOD_S / STEPS
        for _ in range(STEPS):
            if self.speed_rad_s == 0.0 and abs(torque_nm) <= self.dry_nm:
                return
            against = math.copysign(self.dry_nm, self.speed_rad_s or torque_nm) + self.viscous * self.speed_rad_s
            speed = self.speed_rad_s + step_s * (torque_nm - against) / self.inertia
            self.speed_rad_s = 0.0 if speed * self.speed_rad_s < 0.0 else speed
            self.position_rad += step_s * self.speed_rad_s


def report_of(slider: Slider, encoder_late: int, amplifier_late: int, scale: float) -> WiringReport:
    """The test of an axis whose amplifier's sensor shows `scale` times the way; lateness in cycles."""
    test = WiringTest(wiring_test_bounds(axis(joint()).config, {}))
    test.begin(0.0, 0.0)
    shown = deque([0.0] * 10, maxlen=10)
    torque_nm = 0.0
    while test.running:
        slider.go(torque_nm)
        shown.append(slider.position_rad)
        amplifier_rad, encoder_rad = scale * shown[-1 - amplifier_late], shown[-1 - encoder_late]
        amplifier = AmplifierFeedback(0, 0, ENABLED, 0, 10, amplifier_rad, torque_nm, 0, True, Reason.NONE)
        encoder = EncoderFeedback(0, 0, encoder_rad, 0.0, 0)
        torque_nm = test.step(amplifier, encoder, torque_nm, PERIOD_S)
    return test.report()


SLIDERS = {"heavy": (0.001, 0.045, 0.056), "light": (0.0003, 0.045, 0.01), "free": (0.001, 0.01, 0.001)}
LATE = [(0, 0), (1, 0), (3, 0), (0, 3), (4, 0), (0, 4)]


@pytest.mark.parametrize("late", LATE, ids=str)
@pytest.mark.parametrize("slider", SLIDERS)
def test_a_late_sensor_is_no_wrong_scale(slider, late):
    report = report_of(Slider(*SLIDERS[slider]), *late, 1.0)
    assert report.passed, report


#: A joint so fast at the first sign of its motion that twice the way looks like slack: the mismatch of both sensors
#: (limits.encoder_mismatch_rad) finds it later.
LIKE_SLACK = [("light", late, 2.0) for late in LATE if late[0]]
WRONG = [case for case in product(SLIDERS, LATE, (0.25, 0.5, 2.0, 4.0)) if case not in LIKE_SLACK]


@pytest.mark.parametrize(("slider", "late", "scale"), WRONG, ids=str)
def test_a_wrong_scale_is_found_behind_a_late_sensor(slider, late, scale):
    assert report_of(Slider(*SLIDERS[slider]), *late, scale).finding == WiringOutcome.POSITION_SCALE
