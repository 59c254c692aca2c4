"""Equal feedback: what is left to design is chosen on the model, and tracks better than any other choice of it."""

from __future__ import annotations

import numpy as np

from servod.gain_parameters import LocalParameters
from servod.models.simulate import LoopSettings, simulate_closed_loop
from servod.references import paper
from servod.synthesize.gain_set import with_feedback
from servod.synthesize.given_feedback import around_feedback
from tests.synthesize.designs import table1, table1_set

MOTION = np.array([paper(k * 1e-3) for k in range(12_000)])


def test_the_compensation_around_the_papers_feedback_tracks_within_a_tenth_of_a_milliradian() -> None:
    original = table1_set()
    assert original.design is not None
    settings = LoopSettings(velocity_cutoff_hz=original.design.velocity_cutoff_hz)
    errors = []
    for gains in (around_feedback(original, "equal", 2.5, 0.12), with_feedback(original, "plain", 2.5, 0.12, 20.0)):
        law = gains.parameters
        assert isinstance(law, LocalParameters)
        for region in (law.regions.low, law.regions.high):
            assert np.isclose(law.input_scale_nm * region.k_x_per_rad, 2.5) and not region.k_u
        run = simulate_closed_loop(table1(), gains.law.step, gains.pack(), MOTION, settings)
        errors.append(float(np.sqrt(np.mean(run.tracking_error_rad(1.0) ** 2))))
    assert errors[0] < 0.1e-3 and errors[0] < errors[1]
