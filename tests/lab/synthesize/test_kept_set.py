"""The set that other tests read from a file is the one that synthesis makes today, and no processor makes another."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import LocalParameters
from servod.kernels.motions import paper
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.synthesize.deployed import LOW_TORQUE_SHARES, Wishes, bare_proof, empty_design, programme
from servod.lab.synthesize.lmi_deployed import Programme, shaped
from servod.lab.verify.checks import DISK_LIMIT, speeds_of
from servod.lab.verify.margins import Sweep
from servod.lab.verify.proof import region_margin, stored_deviation
from servod.lab.verify.sampled import timing_of
from servod.lab.verify.steady_friction import steady_friction
from tests.lab.synthesize.designs import made_anew, table1, table1_set

#: Largest move of a gain, as a share of the region's largest in scaled units. What rounding leaves open is 2e-6 of it.
GAIN_SHARE = 1e-4
#: Of the programme's numbers: what two processors' sums differ by.
ROUNDING = 1e-13


@cache
def made() -> GainSet:
    """Today's set, made once."""
    return made_anew()


def shaping(index: int) -> Programme:
    """The programme that shapes the feedback of one region of Table I's joint."""
    wishes = next(Wishes().choices())
    assert wishes.cutoff_hz is not None
    design = empty_design(table1(), wishes, wishes.cutoff_hz)
    frame = bare_proof(design, wishes.spans[index], wishes, 1.0 if index else LOW_TORQUE_SHARES[0])
    return programme(design, frame, wishes).only("sliding")


@pytest.mark.parametrize("index", [0, 1])
def test_rounding_in_the_programme_moves_no_gain(index: int) -> None:
    exact, random = shaping(index), np.random.default_rng(3)
    a, b, e = (m * (1.0 + ROUNDING * random.standard_normal(m.shape)) for m in (exact.a, exact.b, exact.e))
    found = [shaped(p) for p in (exact, replace(exact, a=a, b=b, e=e))]
    assert found[0] is not None and found[1] is not None
    first, other = found[0].feedback, found[1].feedback
    assert np.abs(other - first).max() < GAIN_SHARE * np.abs(first).max()


def test_the_kept_set_is_what_synthesis_makes() -> None:
    """Where this fails after a change of synthesis, `python -m tests.lab.synthesize.designs` writes the file again."""
    kept = table1_set()
    assert not kept.seal_broken and not made().seal_broken
    assert kept.design is not None and made().design is not None
    assert kept.design.model_dump(exclude={"regions"}) == made().design.model_dump(exclude={"regions"})
    for old, new in zip(kept.design.regions, made().design.regions, strict=True):
        bounds = [(r.name, r.speed_from_rad_s, r.speed_to_rad_s) for r in (old, new)]
        assert bounds[0] == bounds[1]
        assert [(v.name, v.mode) for v in old.vertices] == [(v.name, v.mode) for v in new.vertices]
        assert new.feedback == pytest.approx(old.feedback, rel=0.0, abs=GAIN_SHARE * np.abs(old.feedback).max())


def test_beside_the_feedback_both_sets_have_the_same_numbers() -> None:
    """Local sets, observer, limits, share at rest: nothing in them is solved for."""
    laws = [gains.parameters for gains in (table1_set(), made())]
    assert all(isinstance(law, LocalParameters) for law in laws)
    plain = [law.model_dump(exclude={"regions", "error_limit_rad", "friction"}) for law in laws]
    assert plain[0] == plain[1]
    kept, again = (law for law in laws if isinstance(law, LocalParameters))
    assert again.error_limit_rad == pytest.approx(kept.error_limit_rad, rel=GAIN_SHARE)
    for old, new in zip(kept.friction.sets, again.friction.sets, strict=True):
        assert new.velocity_rad_s == pytest.approx(old.velocity_rad_s, rel=1e-9)
        assert new.decay_per_s == pytest.approx(old.decay_per_s, rel=1e-9)


@pytest.mark.parametrize("origin", ["kept", "made"])
def test_both_sets_are_proven_and_have_margin(origin: str) -> None:
    gains = table1_set() if origin == "kept" else made()
    design = gains.design
    assert design is not None
    for region in design.regions:
        assert region_margin(region)[0] > 0.0
        assert stored_deviation(design, region) < 1e-9
    sweep = Sweep(gains.law, gains.pack(), steady_friction(table1()), timing_of(design), speeds_of(design, 12))
    assert sweep.disk_margin()[0] > DISK_LIMIT


@pytest.mark.parametrize("origin", ["kept", "made"])
def test_both_sets_track(origin: str) -> None:
    """6.5e-6 rad, and 5 % more or less when a gain moves by 1e-6: rounding of the encoder decides when the joint slips.

    So no test compares the error of two sets closer than that.
    """
    gains = table1_set() if origin == "kept" else made()
    assert gains.design is not None
    motion = np.array([paper(k * 1e-3) for k in range(12_000)])
    settings = LoopSettings(velocity_cutoff_hz=gains.design.velocity_cutoff_hz)
    run = simulate_closed_loop(table1(), gains.law, gains.pack(), motion, settings)
    assert np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2)) < 9e-6
