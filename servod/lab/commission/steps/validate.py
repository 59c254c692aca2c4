"""Step 6: the deployed law and its rivals on the axis itself, on trajectory (19) and on two steps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from servod.client.open import DaemonWalkAxis, VirtualWalkAxis
from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import load_gains
from servod.lab.commission.comparison import DEPLOYED, measured, run_files, save_curves
from servod.lab.commission.daemon_tracking import measure_on_daemon
from servod.lab.commission.state import DEPLOYMENT, GAINS, RIVALS, RUNS, TRACKING, TUNING, write_json
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.steps.rivals import CONTENDERS, compared, contenders, rival_file
from servod.lab.commission.walk import Walk
from servod.lab.tune.plan import Feedback

#: What tuning tells of a law's roughness, by the keys of its document.
ROUGHNESS = ("roughness_ratio", "roughness_limit", "within_roughness_limit")


@dataclass(frozen=True)
class Validate:
    """Leaves the figures of every law, and the curves of its runs.

    In each class every law is tuned by the same rules, within the same limit on roughness. The deployed law, which no
    such limit bounds, is a row of its own beside the free ones; `tracking` has it in place of their `local`. Every law
    says whether it was tuned, its roughness as a multiple of the paper's PD, and whether that is within the limit.
    """

    name: str = "validate"
    title: str = "compare on the axis"

    def outputs(self, walk: Walk) -> tuple[str, ...]:
        """Figures, and what is there of every law's run: one that the axis dropped out under has no curves."""
        runs = [file for key in _keys() for file in run_files(walk, key) if file.exists()]
        return (TRACKING, *(f"{RUNS}/{file.name}" for file in runs))

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """The sets that run, and the axis."""
        sets = [f"{RIVALS}/{rival_file(walk, *who).name}" for who in contenders()] if compared(walk) else []
        return {**walk.hashes(GAINS, TUNING, *sets), "axis": walk.axis.identity, "seed": walk.options.seed}

    def run(self, walk: Walk) -> None:
        """Every law meets the same axis with the same noise."""
        axis = walk.axis
        if isinstance(axis, VirtualWalkAxis):
            write_json(walk.path(TRACKING), _on_virtual(walk, axis, self.title))
        elif isinstance(axis, DaemonWalkAxis):
            walk.questions.agree("track trajectory (19) and steps of 100 and 10 mrad with the deployed set (72 s)?")
            write_json(walk.path(TRACKING), _on_daemon(walk, axis, self.title))


def _keys() -> list[str]:
    """Every law of the comparison."""
    return [DEPLOYED, *(f"{feedback.value}_{name}" for feedback, name in contenders())]


def _on_daemon(walk: Walk, axis: DaemonWalkAxis, title: str) -> dict[str, Any]:
    """The deployed law alone."""
    told = read_json(walk.path(DEPLOYMENT))["gains"]
    deployed, gains = (told["name"], told["version"]), load_gains(walk.path(GAINS))
    with walk.progress(title) as tell:
        tracking, missing = measure_on_daemon(axis.socket, axis.config, deployed, partial(tell, "deployed law"), gains)
    if tracking:
        save_curves(run_files(walk, DEPLOYED)[1], tracking.curves)
    return document({}, tracking.document() if tracking else None, {}) | {"not_measured": missing}


def _on_virtual(walk: Walk, axis: VirtualWalkAxis, title: str) -> dict[str, Any]:
    """The deployed law, and both classes."""
    deployed = load_gains(walk.path(GAINS))
    assert deployed.design is not None  # a certified set has one
    sets = {DEPLOYED: walk.path(GAINS)}
    if compared(walk):
        sets |= {f"{feedback.value}_{name}": rival_file(walk, feedback, name) for feedback, name in contenders()}
    with walk.progress(title) as tell:
        figures = measured(walk, axis, sets, deployed.design.velocity_cutoff_hz, tell)
    if "failed" in (proven := figures.pop(DEPLOYED)):
        raise AnswerIsNo(f"validate: {proven['failed']}")
    return document(figures, proven, read_json(walk.path(TUNING)))


def document(figures: dict[str, Any], deployed: dict[str, Any] | None, tuning: dict[str, Any]) -> dict[str, Any]:
    """Figures by class and law, with what `tuning` (by class and law, of the step before) says of their roughness."""
    classes = {
        feedback: {
            name: figures[key] | _bounded(tuning, feedback, name)
            for name in CONTENDERS
            if (key := f"{feedback.value}_{name}") in figures
        }
        for feedback in Feedback
    }
    free = classes[Feedback.FREE]
    if deployed:
        deployed = deployed | _bounded(tuning, Feedback.FREE, DEPLOYED)
    return {
        "tracking": free | ({"local": deployed} if deployed else {}),
        "equal_feedback": classes[Feedback.EQUAL],
        "free_feedback": free | ({DEPLOYED: deployed} if deployed else {}),
    }


def _bounded(tuning: dict[str, Any], feedback: Feedback, name: str) -> dict[str, Any]:
    """Whether a law was tuned, and its roughness beside the limit; where nothing is compared there is neither."""
    told = tuning.get(feedback.value, {}).get(name, {})
    return {"tuned": name != DEPLOYED} | {key: told[key] for key in ROUGHNESS if key in told}
