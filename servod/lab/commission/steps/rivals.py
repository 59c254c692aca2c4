"""Step 5: the rivals of the deployed law, tuned by the same rules on the same identified model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.lab.commission.comparison import DEPLOYED
from servod.lab.commission.state import GAINS, MODEL, RIVALS, TUNING, write_json, write_text
from servod.lab.commission.walk import Walk
from servod.lab.tune.plan import BUDGET, ROUGHNESS_TOLERANCE, Feedback, Tuned, TuningSettings
from servod.lab.tune.rivals import rivals
from servod.lab.tune.tuning import as_tuned

#: Who is tuned and measured in each class; the deployed law, which is synthesized and not tuned, and which no limit on
#: roughness bounds, stands beside them.
CONTENDERS = ("pd", "pd_dob", "pd_lugre", "local")


@dataclass(frozen=True)
class Rivals:
    """Leaves a gain set for each rival in each class, and what its tuning reached and cost.

    The deployed law is judged by the same measures; it may be over the limit on roughness, which bounds tuning alone.
    """

    name: str = "rivals"
    title: str = "tune the rivals"

    def outputs(self, walk: Walk) -> tuple[str, ...]:
        """The sets themselves, for they are what is compared, and the document of their tuning."""
        sets = [f"{RIVALS}/{rival_file(walk, *who).name}" for who in contenders()] if compared(walk) else []
        return (TUNING, *sets)

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The model, the filter of the deployed set, and the budget."""
        o = walk.options
        return {**walk.hashes(MODEL, GAINS), "seed": o.tuning_seed, "budget": o.budget, "compared": compared(walk)}

    def run(self, walk: Walk) -> None:
        """All of them; the walk keeps those that it will measure."""
        if not compared(walk):
            write_json(walk.path(TUNING), {})
            return
        o, model = walk.options, load_axis_model(walk.path(MODEL))
        with walk.progress(self.title) as on_progress:
            plan = replace(_plan(walk), seed=o.tuning_seed, budget=o.budget or BUDGET)
            found = rivals(
                model,
                CONTENDERS,
                seed=plan.seed,
                budget=plan.budget,
                on_progress=on_progress,
                plan=plan,
                processes=o.processes,
            )
            limit = plan.roughness_limit
            figures = {
                feedback.value: {name: _figures_of(t, limit) for name, t in tuned.items()}
                for feedback, tuned in found.items()
            }
            on_progress("the deployed law by the same measures", 1.0)
            figures[Feedback.FREE.value][DEPLOYED] = _figures_of(
                as_tuned(model, load_gains(walk.path(GAINS)), plan), limit
            )
        for feedback, name in contenders():
            write_text(rival_file(walk, feedback, name), found[feedback][name].gains.to_yaml())
        write_json(walk.path(TUNING), figures)


def compared(walk: Walk) -> bool:
    """Whether rivals run beside the deployed law: a real axis runs what is certified and nothing else."""
    return walk.options.rivals and walk.axis.virtual


def contenders() -> list[tuple[Feedback, str]]:
    """Class and name of every rival."""
    return [(feedback, name) for feedback in Feedback for name in CONTENDERS]


def rival_file(walk: Walk, feedback: Feedback, name: str) -> Path:
    """Where a rival's gain set is."""
    return walk.path(RIVALS) / f"{name}_{feedback.value}.yaml"


def _plan(walk: Walk) -> TuningSettings:
    """The deployed law's own loop: its encoder, cycle and velocity filter, and the axis's torque limit."""
    design = load_gains(walk.path(GAINS)).design
    assert design is not None  # a certified set has one
    return TuningSettings(
        counts_per_turn=design.counts_per_turn,
        cutoff_hz=design.velocity_cutoff_hz,
        period_s=design.period_s,
        torque_limit_nm=walk.axis.config.limits.torque_nm,
    )


def _figures_of(tuned: Tuned, limit: float) -> dict[str, float]:
    """Roughness and its limit are multiples of what the paper's PD makes."""
    return {
        "cost_mrad": tuned.cost,
        "simulations": tuned.simulations,
        "roughness_ratio": tuned.roughness,
        "roughness_limit": limit,
        "within_roughness_limit": tuned.roughness <= (1.0 + ROUGHNESS_TOLERANCE) * limit,
    }
