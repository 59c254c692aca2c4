"""Compiles every kernel once, before the workers of `./test` start: each of them would, and so would their children.

`python -m tests.compile_kernels`; takes half a minute on a new checkout, and three seconds where nothing changed.
"""

from __future__ import annotations

import numpy as np

from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.kernels.laws import LAWS
from servod.kernels.physics.plant import Plant
from servod.lab.diagnose.data.intake import load_traces
from servod.lab.diagnose.predict.predict import Predictor
from servod.lab.simulate.replay import replay
from servod.lab.simulate.simulate import simulate_closed_loop
from servod.qualify.blind.conceal import make_case
from servod.qualify.blind.plan import Settings, plans
from tests.lab.diagnose.axes import believed, record

ECCENTRIC = {"encoder_eccentricity": {"harmonics": [{"amplitude": 0.004, "periods_per_turn": 2.0}]}}


def compile_all() -> None:
    """Runs each kernel once as the programs do."""
    plant = Plant(AxisModel.model_validate(believed(**ECCENTRIC).model_dump()))
    plant.advance(0.0, 1e-3)
    joint, still = load_axis_model(shipped("gains/axes/table1_joint.yaml")), np.zeros((3, 3))
    sets = [load_gains(path) for path in sorted(shipped("gains").glob("*.yaml"))]
    for law in LAWS:
        gains = next((gains for gains in sets if gains.law is LAWS[law]), None)
        if gains is not None:
            simulate_closed_loop(joint, gains.law, gains.pack(), still)
    traces, _ = load_traces(record(believed(), seconds=2.0), believed())
    Predictor(traces, believed()).mismatch(believed())
    replay(believed(), traces[0].drive, 0.25)
    make_case(plans(1, 7, Settings())[0], Settings())


if __name__ == "__main__":
    compile_all()
