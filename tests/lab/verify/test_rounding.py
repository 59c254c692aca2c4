"""What an encoder's rounding makes of a joint: a bound that simulated rounding keeps, and that no weak loop widens."""

from __future__ import annotations

import numpy as np
import pytest

from servod.formats.gains.design import Design
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.effects import Noise
from servod.lab.synthesize.observer_width import with_observer
from servod.lab.verify.checks import Subject
from servod.lab.verify.closed_loop import LoopDeviation
from servod.lab.verify.margins import NOMINAL, Sweep
from servod.lab.verify.rounding import (
    LEAST_COUNTS,
    MOST_COUNTS,
    count_rad,
    gives_way_rad,
    rounding_rad,
    swing_per_count,
)
from tests.lab.synthesize.designs import table1_set


def made() -> tuple[Sweep, Design, LocalParameters]:
    """Table I's set, creeping."""
    gains = table1_set()
    assert gains.design is not None and isinstance(gains.parameters, LocalParameters)
    return Subject(gains, gains.design, 1, 1, 1).sweep(2).at([0.002, 0.01]), gains.design, gains.parameters


def test_a_joint_moves_with_its_rounding_and_more_where_it_is_less_damped() -> None:
    sweep, _, _ = made()
    nominal, harder = swing_per_count(sweep, NOMINAL), swing_per_count(sweep, [LoopDeviation(viscous=0.5, slope=1.5)])
    assert 1.0 < nominal < harder < 8.0


@pytest.mark.parametrize(("bits", "counts"), [(20, (LEAST_COUNTS, MOST_COUNTS)), (0, (0.0, 0.0))])
def test_the_swing_is_some_counts_of_the_encoder_and_none_without_counts(
    bits: int, counts: tuple[float, float]
) -> None:
    sweep, design, _ = made()
    asked = design.model_copy(update={"counts_per_turn": 2.0**bits if bits else 0.0})
    step = 2.0 * np.pi / 2**bits if bits else 0.0
    assert count_rad(asked) == pytest.approx(step)
    assert counts[0] * step <= rounding_rad(sweep, asked) <= counts[1] * step


def test_noise_of_the_torque_moves_a_joint_against_its_feedback() -> None:
    _, design, law = made()
    model = design.model.model_copy(update={"noise": Noise(torque_rms=3e-4)})
    stiffness = law.input_scale_nm * min(law.regions.low.k_x_per_rad, law.regions.high.k_x_per_rad)
    found = gives_way_rad(law, design.model_copy(update={"model": model}))
    assert found == pytest.approx(7.0 * 3e-4 / stiffness)
    assert gives_way_rad(law, design.model_copy(update={"model": model.model_copy(update={"noise": None})})) == 0.0


def test_coming_to_rest_is_judged_with_the_observer_that_acts_then() -> None:
    gains, (_, design, law) = table1_set(), made()
    assert law.disturbance_observer is not None
    bandwidth = law.disturbance_observer.bandwidth_rad_s

    def margin(low_rad_s: float | None) -> float:
        own = gains.model_copy(update={"parameters": with_observer(law, bandwidth, low_rad_s)})
        return Subject(own, design, 1, 1, 1).sweep(6).disk_margin()[0]

    same, fast = margin(None), margin(1500.0)
    assert fast < 0.6 * same
