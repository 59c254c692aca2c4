"""How fast the output observer may be: a search that judges less than the certificate, and not otherwise."""

from __future__ import annotations

import math

import pytest

from servod.formats.gains.design import Design
from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws import LAWS
from servod.lab.synthesize.observer_width import DISK_WANTED, LOW_FACTORS, Search, low_bandwidths, with_observer
from servod.lab.verify.closed_loop import late_corners
from servod.lab.verify.margins import Sweep
from servod.lab.verify.sampled import timing_of
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1, table1_set


def made() -> tuple[Design, LocalParameters]:
    """Design and law of Table I's set."""
    gains = table1_set()
    assert gains.design is not None and isinstance(gains.parameters, LocalParameters)
    assert gains.parameters.disturbance_observer is not None
    return gains.design, gains.parameters


def test_poles_and_margins_judged_at_once_are_those_judged_apart() -> None:
    design, law = made()
    sweep = Sweep(LAWS["local"], law.pack(), steady_friction(table1()), timing_of(design), [0.002, 0.05, 0.3])
    cases = late_corners(design.uncertainty)
    found, (margin, at) = sweep.judge(cases), sweep.disk_margin(cases)
    assert found.radius == pytest.approx(sweep.worst(cases).radius, rel=1e-12)
    assert (found.disk_margin, found.disk_at_rad_s) == (pytest.approx(margin, rel=1e-9), at)
    assert sweep.judge(found.hardest).disk_margin == found.disk_margin
    assert len(found.hardest) < len(cases)


def test_a_law_that_is_refused_leaves_the_speed_at_which_the_next_is_tried_first() -> None:
    design, law = made()
    search = Search(design, steady_friction(table1()))
    assert not search.stands(with_observer(law, 600.0, 600.0), DISK_WANTED)
    assert len(search.refused_at) == 1 and 0.0 < search.refused_at[0] < 1.5 * design.speed_max_rad_s


@pytest.mark.parametrize(("bits", "faster"), [(24, True), (15, False)])
def test_in_the_region_of_rest_a_coarse_encoder_bounds_the_observer(bits: int, faster: bool) -> None:
    design, law = made()
    slow = with_observer(law, 10.0, LOW_FACTORS[-1] * 10.0)
    found = list(
        low_bandwidths(design.model_copy(update={"counts_per_turn": 2.0**bits}), steady_friction(table1()), slow)
    )
    assert bool(found) == faster
    assert found == sorted(found, reverse=True) and all(30.0 < low <= 100.0 and math.isfinite(low) for low in found)
