"""l_i of laws without output observer: designed within their margin, of use on the trajectory, of one sign only."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.kernels.laws import LAWS
from servod.kernels.motions import paper
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.synthesize.gain_set import DesignOptions, synthesize
from servod.lab.synthesize.observer_width import GAINS, MARGIN, with_gains
from servod.lab.verify.checks import speeds_of
from servod.lab.verify.closed_loop import corners
from servod.lab.verify.margins import NOMINAL, Sweep
from servod.lab.verify.sampled import SampledTiming
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import table1


@cache
def without_observer() -> GainSet:
    found = synthesize(table1(), options=DesignOptions(observer=False))
    assert isinstance(found, GainSet)
    return found


def law_of(gains: GainSet) -> LocalParameters:
    assert isinstance(gains.parameters, LocalParameters)
    return gains.parameters


def sweep(law: LocalParameters) -> Sweep:
    design = without_observer().design
    assert design is not None
    timing = SampledTiming(design.period_s, design.model.total_delay_s, design.velocity_cutoff_hz)
    return Sweep(LAWS["local"], law.pack(), steady_friction(table1()), timing, speeds_of(design, 25))


def rms_mrad(law: LocalParameters) -> float:
    design = without_observer().design
    assert design is not None
    motion = np.array([paper(k * 1e-3) for k in range(12_000)])
    settings = LoopSettings(velocity_cutoff_hz=design.velocity_cutoff_hz)
    run = simulate_closed_loop(table1(), LAWS["local"], law.pack(), motion, settings)
    return 1e3 * float(np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2)))


def test_the_gains_are_of_the_useful_size_and_grow_with_the_speed() -> None:
    sets = law_of(without_observer()).friction.sets
    slow = [s.gain for s in sets if abs(s.velocity_rad_s) < 0.003]
    fast = [s.gain for s in sets if abs(s.velocity_rad_s) > 0.3]
    assert all(0.01 <= gain <= 0.06 for gain in slow) and min(fast) > max(slow)
    assert all(gain <= GAINS[-1] for gain in fast)


def test_the_loop_stands_at_every_corner_with_the_margin() -> None:
    judged, design = sweep(law_of(without_observer())), without_observer().design
    assert design is not None
    assert judged.worst(corners(design.uncertainty)).radius < 1.0
    assert judged.disk_margin()[0] > 0.9 * MARGIN


def test_it_tracks_much_better_than_without() -> None:
    law = law_of(without_observer())
    assert rms_mrad(law) < 0.6 * rms_mrad(with_gains(law, [1.0], [0.0]))


@pytest.mark.parametrize("gain", [-0.01, -0.04])
def test_the_other_sign_is_unstable_and_the_sweep_of_the_certificate_says_so(gain: float) -> None:
    law = law_of(without_observer())
    assert sweep(with_gains(law, [1.0], [gain])).worst(NOMINAL).radius > 1.0


def test_a_given_gain_is_taken_as_it_is() -> None:
    given = synthesize(table1(), options=DesignOptions(observer=False, gain=0.02))
    assert isinstance(given, GainSet)
    assert {s.gain for s in law_of(given).friction.sets} == {0.02}
