"""What a certificate promises of the validation motion: the worst that drawn plants show, which a deployment measures.

Stands on the compiled simulator and the validation motion, beside the checks: a promise is kept on the axis, not here.
"""

from __future__ import annotations

import numpy as np

from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Promise
from servod.formats.model.axis_model import AxisModel
from servod.lab.simulate.noise import noise_of, noise_series
from servod.lab.simulate.simulate import LoopSettings, simulate_closed_loop
from servod.lab.verify.plants import drawn
from servod.lab.verify.trials import scale_of
from servod.lab.verify.validation import STEP_S, Array, Figures, Part, ValidationMotion, motion_for

PLANTS = 24


def promise(gains: GainSet, design: Design, seed: int) -> Promise | None:
    """Worst figures over the model and PLANTS plants of the intervals; None where one does not get through."""
    motion = motion_for(design)
    resolution_rad = 2.0 * np.pi / design.counts_per_turn if design.counts_per_turn else 0.0
    rows, noise = motion.rows(), noise_of(design.model, resolution_rad)
    plants = [design.model, *(drawn(design.model, design.uncertainty, seed, i) for i in range(PLANTS))]
    runs = [simulated(gains, design, plant.model_copy(update={"noise": noise}), motion, rows) for plant in plants]
    worst = {part: max(figures.mean(part) for figures in runs) for part in Part}
    if not np.isfinite(list(worst.values())).all():
        return None
    return Promise(
        slow_rad=worst[Part.SLOW], brisk_rad=worst[Part.BRISK], hold_rad=worst[Part.HOLD], plants=len(plants)
    )


def simulated(
    gains: GainSet, design: Design, plant: AxisModel, motion: ValidationMotion, rows: Array, seed: int = 0
) -> Figures:
    """Figures of `plant` under `gains` along the validation motion (`rows` of it), as the encoder shows them."""
    rest = np.zeros((round(0.1 / design.period_s), 3))
    torque, reading = noise_series(plant.noise, len(rest) + len(rows), design.period_s, seed)
    run = simulate_closed_loop(
        plant,
        gains.law.step,
        gains.pack(),
        np.concatenate([rest, rows]),
        LoopSettings(design.period_s, design.counts_per_turn, design.velocity_cutoff_hz, scale_of(design).torque_nm),
        external_nm=torque,
        reading_rad=reading,
    )
    position = run.encoder_rad[len(rest) :]
    steps = round(STEP_S / design.period_s)
    sines = len(rows) - 2 * steps
    return motion.figures(rows[:sines, 0] - position[:sines], (position[sines : sines + steps], position[-steps:]))
