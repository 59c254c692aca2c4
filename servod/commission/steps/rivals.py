"""Step 5: the rivals of the deployed law, tuned by the same rules on the same identified model."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from servod.axis_model import load_axis_model
from servod.commission.files import GAINS, MODEL, RIVALS, TUNING, write_json, write_text
from servod.commission.walk import Walk
from servod.gains import load_gains
from servod.tune.laws import RIVALS as RIVAL_LAWS
from servod.tune.plan import BUDGET, Feedback, Tuned, TunePlan
from servod.tune.rivals import rivals

#: Who is measured in each class. The deployed law stands beside the free ones as it is.
CLASSES: dict[Feedback, tuple[str, ...]] = {
    Feedback.EQUAL: ("pd", "pd_dob", "pd_lugre", "local"),
    Feedback.FREE: ("pd", "pd_dob", "pd_lugre"),
}


@dataclass(frozen=True)
class Rivals:
    """Leaves a gain set for each rival in each class, and what its tuning reached and cost."""

    name: str = "rivals"
    title: str = "tune the rivals"
    outputs: tuple[str, ...] = (TUNING,)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The model, the filter of the deployed set, and the budget."""
        o = walk.options
        return {**walk.hashes(MODEL, GAINS), "seed": o.seed, "budget": o.budget, "compared": compared(walk)}

    def run(self, walk: Walk) -> None:
        """All of them; the walk keeps those that it will measure."""
        if not compared(walk):
            write_json(walk.path(TUNING), {})
            return
        o, model = walk.options, load_axis_model(walk.path(MODEL))
        with walk.progress(self.title) as tell:
            shares: dict[str, float] = {}

            def heard(name: str, share: float) -> None:
                shares[name] = share
                tell(name, sum(shares.values()) / len(RIVAL_LAWS))

            found = rivals(
                model, seed=o.seed, budget=o.budget or BUDGET, tell=heard, plan=_plan(walk), processes=o.processes
            )
        for feedback, name in contenders():
            write_text(rival_file(walk, feedback, name), found[feedback][name].gains.to_yaml())
        write_json(walk.path(TUNING), {f.value: _told(tuned) for f, tuned in found.items()})


def compared(walk: Walk) -> bool:
    """Whether rivals run beside the deployed law: a real axis runs what is certified and nothing else."""
    return walk.options.rivals and walk.axis.virtual


def contenders() -> list[tuple[Feedback, str]]:
    """Class and name of every rival."""
    return [(feedback, name) for feedback, names in CLASSES.items() for name in names]


def rival_file(walk: Walk, feedback: Feedback, name: str) -> Path:
    """Where a rival's gain set is."""
    return walk.path(RIVALS) / f"{name}_{feedback.value}.yaml"


def _plan(walk: Walk) -> TunePlan:
    """The deployed law's own loop: its encoder, cycle and velocity filter, and the axis's torque limit."""
    design = load_gains(walk.path(GAINS)).design
    assert design is not None  # a certified set has one
    return TunePlan(
        counts_per_turn=design.counts_per_turn,
        cutoff_hz=design.velocity_cutoff_hz,
        period_s=design.period_s,
        torque_limit_nm=walk.axis.config.limits.torque_nm,
    )


def _told(tuned: dict[str, Tuned]) -> dict[str, dict[str, float]]:
    return {
        name: {"cost_mrad": t.cost, "simulations": t.simulations, "roughness": t.roughness} for name, t in tuned.items()
    }
