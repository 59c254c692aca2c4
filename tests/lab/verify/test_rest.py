"""At rest a joint is still held: what a set may call rest, its loop there, and the loads that it must stand."""

from __future__ import annotations

from functools import cache

import pytest

from servod.formats.gains.gain_set import CertificateCheck
from servod.formats.gains.parameters import LocalParameters
from servod.lab.verify.checks import Subject
from servod.lab.verify.rest_checks import check_loads, check_rest, resting_radius, resting_speed
from servod.lab.verify.rounding import LEAST_SHARE, REST_SIGMAS, hold_width, rest_width
from tests.lab.synthesize.designs import table1_set
from tests.lab.verify.test_trials import noisy


def resting(within_rad: float | None = None, share: float | None = None) -> Subject:
    """Table I's set with another idea of rest, sealed again."""
    gains = table1_set()
    local = gains.parameters
    assert isinstance(local, LocalParameters)
    other = {"rest_within_rad": within_rad, "rest_share": share} if within_rad else {}
    changed = gains.model_copy(update={"parameters": local.model_copy(update=other)}).sealed()
    assert changed.design is not None
    return Subject(changed, changed.design, 4, 1, 1)


@cache
def loads(off: bool) -> list[CertificateCheck]:
    """What loads say of the set, as synthesized, and with the feedback off as far as 1.5 mrad."""
    return list(check_loads(resting(1.5e-3, 1e-3) if off else resting()))


def failed(checks: list[CertificateCheck]) -> list[str]:
    return [check.name for check in checks if not check.passed]


def test_a_synthesized_set_rests_as_far_as_its_encoder_says() -> None:
    s = resting()
    assert failed(list(check_rest(s))) == [] and failed(loads(off=False)) == []
    local = s.gains.parameters
    assert isinstance(local, LocalParameters)
    assert local.rest_within_rad == rest_width(s.design) and local.hold_within_rad == hold_width(s.design)
    heard = s.design.model_copy(update={"model": noisy()})
    rms = (3e-6**2 - (hold_width(s.design) / 0.6) ** 2 / 12.0) ** 0.5
    assert rest_width(heard) == pytest.approx(hold_width(s.design) + REST_SIGMAS * rms)


def test_a_wider_rest_or_a_smaller_share_is_refused_by_its_numbers() -> None:
    wide, weak = resting(1.5e-3, 0.3), resting(rest_width(resting().design), 0.5 * LEAST_SHARE)
    assert failed(list(check_rest(wide)))[0] == "width within which a joint is at rest [rad]"
    assert failed(list(check_rest(weak))) == ["share of the feedback that is left at rest"]


def test_loads_find_a_feedback_that_is_off_at_rest() -> None:
    names = failed(loads(off=True))
    assert any("load step" in name for name in names) and any("slow load" in name for name in names)
    assert any("blows" in name for name in names)


def test_the_loop_at_rest_is_judged_where_the_joint_slides() -> None:
    """Faster than it can at rest the loop would not stand: the check looks there when the width lets it."""
    s = resting()
    local = s.gains.parameters
    assert isinstance(local, LocalParameters) and local.rest_within_rad
    assert resting_radius(s, local, resting_speed(local.rest_within_rad)) < 1.0 < resting_radius(s, local, 0.1)
