"""The criterion in numbers: chance and encoder counts are allowed for, more is not."""

from __future__ import annotations

import numpy as np
import pytest

from servod.formats.gains.gain_set import Promise
from servod.lab.deploy.judge import promise_limits, rejections
from servod.lab.verify.validation import Figures, Part, ValidationMotion

PROMISE = Promise(slow_rad=2e-5, brisk_rad=1e-4, hold_rad=1e-5, plants=25)
COUNT_RAD = 6e-6


def figures(slow: float = 2e-5, brisk: float = 1e-4, hold: float = 1e-5, scatter: float = 0.0) -> Figures:
    wave = scatter * np.array([-1.0, 0.0, 1.0])
    return Figures({Part.SLOW: tuple(slow + wave), Part.BRISK: tuple(brisk + wave), Part.HOLD: (hold, hold)})


def test_the_same_again_is_no_worse() -> None:
    assert rejections(figures(), figures(), PROMISE, COUNT_RAD) == []


def test_worse_within_the_scatter_stays_and_beyond_it_goes() -> None:
    before = figures(slow=1e-5, scatter=4e-6)
    assert rejections(before, figures(slow=2.5e-5 - 2e-6), PROMISE, COUNT_RAD) == []
    (said,) = rejections(figures(slow=1e-5), figures(slow=2.5e-5), PROMISE, COUNT_RAD)
    assert "slow sine went from 0.01 to 0.025 mrad" in said


def test_a_restless_set_does_not_widen_its_own_limit() -> None:
    before = figures(slow=1e-5)
    calm, restless = figures(slow=2.5e-5), figures(slow=2.5e-5, scatter=2.4e-5)
    assert rejections(before, restless, PROMISE, COUNT_RAD) == rejections(before, calm, PROMISE, COUNT_RAD) != []


def test_a_hold_that_swings_more_than_before_goes_though_it_was_promised() -> None:
    promised = PROMISE.model_copy(update={"hold_rad": 1e-4})
    before, limit = figures(hold=1e-5), 1.1e-5 + 4.0 * COUNT_RAD + 0.05 * 2e-5
    assert rejections(before, figures(hold=0.99 * limit), promised, COUNT_RAD) == []
    (said,) = rejections(before, figures(hold=1.01 * limit), promised, COUNT_RAD)
    assert said.startswith("swing while it holds")
    stuck = figures(slow=8e-3, hold=1e-5)  # milliradians away, and still
    assert rejections(stuck, figures(hold=1.3e-4), promised, COUNT_RAD) == []


@pytest.mark.parametrize("part", list(Part))
def test_a_broken_promise_is_named(part: Part) -> None:
    limit = promise_limits(PROMISE, COUNT_RAD)[part]
    poor = figures(slow=1.0, brisk=1.0, hold=1.0)
    kept, broken = (figures(**{part.value: factor * limit}) for factor in (0.99, 1.01))
    assert rejections(poor, kept, PROMISE, COUNT_RAD) == []
    (said,) = rejections(poor, broken, PROMISE, COUNT_RAD)
    assert "the certificate promised" in said


def test_figures_are_read_per_period_without_the_first_ones() -> None:
    motion = ValidationMotion(0.001, 0.02, 0.004, 8.0, 0.002)
    error = np.zeros(len(motion.sines))
    error[750 : 750 + 2000] = 1.0  # the first period of the slow sine
    error[750 + 2000 : 750 + 4000] = 0.5
    held = np.concatenate([np.linspace(0.0, 1.0, 500), np.linspace(1.0, 1.2, 500)])
    found = motion.figures(error, (held, held))
    assert found.of[Part.SLOW] == (0.5, 0.0, 0.0)
    assert set(found.of[Part.BRISK]) == {0.0} and len(found.of[Part.BRISK]) == 12
    assert found.of[Part.HOLD] == pytest.approx((0.2, 0.2), rel=0.01)
    with pytest.raises(ValueError, match="end"):
        motion.figures(error[:5000], (held, held))
