"""The local law around a feedback that is given: what equal feedback leaves to design, chosen on the axis model.

Beside the synthesis, for comparisons at equal feedback. Nothing proves such a set: where the Stribeck curve falls by
more than the damping that was given, no compensation can be proven, and the best that is left is found by simulation.
"""

from __future__ import annotations

import itertools

import numpy as np

from servod.gain_parameters import LocalParameters, VelocitySource
from servod.gains import GainSet
from servod.models.simulate import LoopSettings, simulate_closed_loop
from servod.references import paper
from servod.synthesize.gain_set import with_feedback

#: Bandwidths of the output observer that are tried [rad/s]; more shakes the torque.
BANDWIDTHS_RAD_S = (20.0, 35.0, 50.0, 80.0, 120.0)
TRIAL_S, SETTLE_S = 12.0, 1.0


def around_feedback(gains: GainSet, name: str, position_nm_per_rad: float, velocity_nms_per_rad: float) -> GainSet:
    """`gains` with this PD feedback in both regions, and the observer and velocity source that track (19) best with it.

    Judged on the model of the set's design, with the encoder and the filter that it states; a velocity filter of the
    design therefore belongs to the result. Without design or certificate, as `with_feedback`.
    """
    assert gains.design is not None
    candidates = [
        _with_source(with_feedback(gains, name, position_nm_per_rad, velocity_nms_per_rad, bandwidth), source)
        for bandwidth, source in itertools.product(BANDWIDTHS_RAD_S, VelocitySource)
    ]
    return min(candidates, key=lambda candidate: _rms_rad(gains, candidate))


def _with_source(gains: GainSet, source: VelocitySource) -> GainSet:
    law = gains.parameters
    assert isinstance(law, LocalParameters)
    friction = law.friction.model_copy(update={"velocity": source})
    return gains.model_copy(update={"parameters": law.model_copy(update={"friction": friction})})


def _rms_rad(original: GainSet, candidate: GainSet) -> float:
    """RMS tracking error on (19); infinite for a candidate that runs away."""
    design = original.design
    assert design is not None
    motion = np.array([paper(k * design.period_s) for k in range(round(TRIAL_S / design.period_s))])
    settings = LoopSettings(design.period_s, design.counts_per_turn, design.velocity_cutoff_hz)
    run = simulate_closed_loop(design.model, candidate.law.step, candidate.pack(), motion, settings)
    rms = float(np.sqrt(np.mean(run.tracking_error_rad(SETTLE_S) ** 2)))
    return rms if np.isfinite(rms) else np.inf
