"""A joint that was thrown off its motion comes back under a certified set, and a set that keeps it is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from servod.client.axis import ReferenceMotion
from servod.client.open import stepped_axis
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import GainSet, load_gains, pd_set
from servod.formats.gains.parameters import LocalParameters, VelocitySource
from servod.formats.model.axis_model import load_axis_model
from servod.formats.recording.record import RECORD, CycleRecord
from servod.lab.synthesize.observer_width import with_observer
from servod.lab.verify.checks import Subject
from servod.lab.verify.pushes import (
    BEFORE_PERIODS,
    BEFORE_SHARE,
    CYCLES,
    PushedOff,
    check_pushes,
    frequencies_hz,
    sine,
    swing_limit_rad,
)
from servod.lab.verify.trials import scale_of


def certified() -> GainSet:
    return load_gains(shipped("gains/demo_local_certified.yaml"))


def with_reference_alone(gains: GainSet) -> GainSet:
    """Friction in the phase of the reference whatever the joint does, and an observer that gathers fast."""
    law = gains.parameters
    assert isinstance(law, LocalParameters) and law.disturbance_observer is not None
    observer = law.disturbance_observer
    moving = with_observer(law, observer.bandwidth_rad_s, observer.low_bandwidth_rad_s, observer.low_bandwidth_rad_s)
    friction = law.friction.model_copy(update={"velocity": VelocitySource.REFERENCE})
    changed = {"name": "kept", "parameters": moving.model_copy(update={"friction": friction}), "certificate": None}
    return gains.model_copy(update=changed).sealed()


def thrown(gains: GainSet) -> PushedOff:
    assert gains.design is not None
    return PushedOff(gains, gains.design.model, gains.design, scale_of(gains.design))


def test_the_set_that_ships_has_no_second_steady_motion() -> None:
    good = certified()
    assert good.design is not None
    (check,) = check_pushes(Subject(good, good.design, 1, 1, 1))
    assert check.passed, check


def test_a_second_steady_motion_is_refused() -> None:
    """With the model alone; drawn plants only make it worse."""
    kept = with_reference_alone(certified())
    assert kept.design is not None
    assert max(thrown(kept).excesses_rad()) > 20.0 * swing_limit_rad(kept.design)


@pytest.mark.parametrize(("frequency_hz", "speed_rad_s"), [(0.5, 0.1), (3.0, 0.02), (20.0, 0.1)])
def test_what_comes_back_differs_by_less_than_a_count(frequency_hz: float, speed_rad_s: float) -> None:
    found = thrown(certified())
    assert abs(found.excess_rad(frequency_hz, speed_rad_s)) < 2.0 * math.pi / 2**20


def test_a_law_that_swings_by_itself_is_no_small_figure() -> None:
    """From rest on, so that there is no motion without a swing to compare with."""
    gains = certified()
    law, design = gains.parameters, gains.design
    assert isinstance(law, LocalParameters) and design is not None
    feedback = {"k_x_per_rad": 2e4, "k_u": None}
    regions = {name: getattr(law.regions, name).model_copy(update=feedback) for name in ("low", "high")}
    wild = law.model_copy(update={"regions": law.regions.model_copy(update=regions)})
    found = thrown(gains.model_copy(update={"parameters": wild}))
    assert found.excess_rad(3.0, 0.02) > 10.0 * swing_limit_rad(design)


def test_a_joint_that_stands_under_a_sine_of_a_few_counts_does_not_swing() -> None:
    """No law can follow what its encoder hardly shows; without feedback the error is the sine itself, pushed or not."""
    design = certified().design
    assert design is not None
    coarse = design.model_copy(update={"counts_per_turn": 2.0**17})
    standing = PushedOff(pd_set("none", 0.0, 0.0), coarse.model, coarse, scale_of(coarse))
    amplitude_rad = 1.9 * swing_limit_rad(coarse)
    assert amplitude_rad / math.sqrt(2.0) > swing_limit_rad(coarse)
    assert standing.excess_rad(2.5, 2.0 * math.pi * 2.5 * amplitude_rad) < 0.1 * swing_limit_rad(coarse)


@dataclass(frozen=True)
class Swinging(PushedOff):
    """A joint whose error swings by so much whatever goes before."""

    swing_rad: float = 0.0

    def _swing_rad(self, *_motion: object) -> float:
        return self.swing_rad


@pytest.mark.parametrize(
    ("swing", "amplitude", "rounding", "passes"),
    [
        (1.5, 1.2, 0.0, False),
        (1.5, 2.1, 0.0, True),
        (1.1, 0.5, 0.0, False),
        (1.1, 0.5, 0.3, True),
        (2.4, 4.0, 0.0, False),
    ],
    ids=["swings by more than the sine", "stands", "hunts", "by its rounding", "does not follow"],
)
def test_what_swings_more_than_a_joint_that_stands_or_its_rounding_is_refused(
    swing, amplitude, rounding, passes
) -> None:
    """All in units of what may be left of a push; the rounding from peak to peak over what its RMS is of that."""
    gains = certified()
    design = gains.design
    assert design is not None
    limit = swing_limit_rad(design)
    given = {"rounding_rad": rounding * limit * 2.0 * math.sqrt(2.0), "swing_rad": swing * limit}
    joint = Swinging(gains, design.model, design, scale_of(design), **given)
    excess = joint.excess_rad(3.0, 2.0 * math.pi * 3.0 * amplitude * limit)
    assert excess == (pytest.approx(0.0, abs=1e-12) if passes else pytest.approx(swing * limit))


@pytest.mark.parametrize("period_s", [0.0005, 0.001, 0.002, 0.003, 0.004, 0.007, 0.02])
def test_what_went_before_ends_at_full_speed_and_all_sines_fit_the_cycle(period_s: float) -> None:
    highest = frequencies_hz(period_s)[-1]
    before_hz = BEFORE_SHARE * highest
    before = sine(0.5 / (2.0 * math.pi * before_hz), before_hz, BEFORE_PERIODS / before_hz, period_s)
    assert before[-1, 1] == pytest.approx(0.5, rel=0.01)
    assert highest * CYCLES * period_s <= 1.0 + 1e-9


def test_a_drive_that_cannot_is_not_asked() -> None:
    """A heavy joint at 20 Hz wants more torque than there is: what is judged is the law, not the drive's limit."""
    gains = certified()
    assert gains.design is not None
    model = gains.design.model.model_copy(update={"inertia": 0.05})
    heavy = PushedOff(gains, model, gains.design, scale_of(gains.design))
    judged: list[tuple[float, float]] = []
    object.__setattr__(heavy, "excess_rad", lambda f, v: judged.append((f, v)) or 0.0)
    assert list(heavy.excesses_rad()) and max(2.0 * math.pi * f * v * 0.05 for f, v in judged) < heavy.scale.torque_nm


def test_a_drive_that_has_the_torque_for_no_sine_proves_nothing() -> None:
    gains = certified()
    assert gains.design is not None
    weak = gains.design.model_copy(update={"torque_limit_nm": 0.01})
    (check,) = check_pushes(Subject(gains, weak, 1, 1, 1))
    assert not check.passed and check.value > 1e6 * check.limit


@pytest.mark.parametrize(("amplitude_rad", "frequency_hz"), [(3.5e-4, 5.477), (7.3e-5, 15.38)])
def test_the_axis_that_the_loop_runs_comes_back_too(amplitude_rad: float, frequency_hz: float, tmp_path: Path) -> None:
    """The loop's own motions, one behind the other, and the joint that the shipped set was identified on."""
    joint = load_axis_model(shipped("gains/axes/demo_joint.yaml"))

    def rms_rad(gains: GainSet, before: bool) -> float:
        folder = tmp_path / f"{gains.name}{before}"
        folder.mkdir()
        with stepped_axis(joint, gains, folder, 3) as axis:
            if before:
                axis.run(ReferenceMotion.sine(0.02, 5.0, 2.0))
            raw = axis.run(ReferenceMotion.sine(amplitude_rad, frequency_hz, 2.0))
        rows = [row for row in map(CycleRecord._make, RECORD.iter_unpack(raw)) if row.reference_active]
        return float(np.sqrt(np.mean([(row.reference_rad - row.position_rad) ** 2 for row in rows[-1000:]])))

    assert rms_rad(certified(), True) < 1.2 * rms_rad(certified(), False)
    assert rms_rad(with_reference_alone(certified()), True) > 1e-3
