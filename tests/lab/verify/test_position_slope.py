"""Torques over position in the loop check: their slopes, and that the sampled loop feels them as stiffness."""

from __future__ import annotations

import pytest

from servod.formats.gains.design import Uncertainty
from servod.formats.gains.parameters import LocalParameters
from servod.formats.model.effects import Cogging, Gravity, Spring
from servod.formats.model.keys import Harmonic
from servod.lab.verify.checks import Subject, check_loop
from servod.lab.verify.closed_loop import LoopDeviation
from servod.lab.verify.plants import drawn
from servod.lab.verify.steady_friction import position_slopes
from tests.lab.synthesize.designs import table1, table1_set

COGGING = Cogging(harmonics=(Harmonic(amplitude=0.004, periods_per_turn=36.0),))
STEEPEST = "largest pole, steepest torque over position"


def subject(model_of_design: object = None) -> Subject:
    gains = table1_set()
    assert gains.design is not None
    design = gains.design.model_copy(update={"model": model_of_design}) if model_of_design else gains.design
    return Subject(gains, design, 1, 1, 1)


def test_slopes_of_waves_and_springs_add_up() -> None:
    model = table1().model_copy(update={"cogging": COGGING, "gravity": Gravity(amplitude=0.2)})
    assert position_slopes(table1(), 1.0) == (0.0, 0.0)
    assert position_slopes(model, 2.0) == pytest.approx((-0.172, 0.172))
    sprung = model.model_copy(update={"spring": Spring(stiffness=0.5, cubic=0.1)})
    assert position_slopes(sprung, 1.0) == pytest.approx((-0.344, 0.344 + 0.5 + 0.3))


def test_the_loop_stands_cogging_and_is_judged_by_it_only_where_there_is_some() -> None:
    assert STEEPEST not in {check.name for check in check_loop(subject())}
    checks = {check.name: check for check in check_loop(subject(table1().model_copy(update={"cogging": COGGING})))}
    assert checks[STEEPEST].passed


def test_drawn_plants_differ_in_what_is_fed_forward() -> None:
    model = table1().model_copy(update={"cogging": COGGING, "gravity": Gravity(amplitude=0.2)})
    plants = [drawn(model, Uncertainty(), 1, index) for index in range(30)]
    cogging = [plant.cogging.harmonics[0].amplitude / 0.004 for plant in plants if plant.cogging]
    gravity = [plant.gravity.amplitude / 0.2 for plant in plants if plant.gravity]
    assert cogging == pytest.approx(gravity) and len(set(cogging)) == 30
    assert 0.8 <= min(cogging) < 0.9 and 1.1 < max(cogging) <= 1.2


def test_a_slope_that_outweighs_the_feedback_is_unstable() -> None:
    judged, law = subject(), table1_set().parameters
    assert isinstance(law, LocalParameters)
    stiffness = law.input_scale_nm * min(law.regions.low.k_x_per_rad, law.regions.high.k_x_per_rad)
    loose = [LoopDeviation(position_slope=factor * stiffness) for factor in (-0.2, -20.0)]
    radii = [judged.coarse.worst([case]).radius for case in loose]
    assert radii[0] < 1.0 < radii[1]
