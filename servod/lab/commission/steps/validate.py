"""Step 6: the deployed law and its rivals on the axis itself, on trajectory (19) and on two steps."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from servod.client.axis import AxisClient, ReferenceMotion
from servod.client.control import ControlClient, Refused, RemoteBadInput
from servod.client.open import DaemonWalkAxis, VirtualWalkAxis
from servod.client.under_daemon import DaemonAxis, require_daemon_config
from servod.common.errors import AnswerIsNo
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import GainSet, load_gains
from servod.lab.commission.comparison import DEPLOYED, measured, run_files, save_curves
from servod.lab.commission.state import DEPLOYMENT, GAINS, RIVALS, RUNS, TRACKING, TUNING, write_json
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.steps.rivals import CONTENDERS, compared, contenders, rival_file
from servod.lab.commission.walk import Walk
from servod.lab.tracking.metrics import HOLD_S, PAPER_S, REST_S, STEPS_MRAD, Curves, Tracking, known_noise, tracking
from servod.lab.tracking.stepped import curves_of
from servod.lab.tune.plan import Feedback

# --- Under a daemon --------------------------------------------------------------------------------------------------
# The tracking comparison on an axis under a daemon: the deployed law alone, as far as the axis's limits allow.


def measure_on_daemon(
    socket: Path,
    config: AxisConfig,
    deployed: tuple[str, int],
    on_progress: Callable[[float], None],
    gains: GainSet | None = None,
) -> tuple[Tracking | None, list[str]]:
    """Figures of the set `deployed` (name, version), and what the daemon refused; None where it refused (19).

    `gains` is that set, where it is at hand: its design knows the encoder's noise. The axis is left enabled or not, as
    it was. Raises AnswerIsNo when another set runs or the axis drops out, BadInput when the daemon has another
    configuration than `config`, Unreachable when it does not answer any more.
    """
    with ControlClient(socket) as client:
        require_daemon_config(client, config)
        axis = DaemonAxis(client)
        _require_active(axis, deployed)
        with _enabled(axis):
            curves, refused = _recorded(axis, on_progress)
    if "paper" not in curves:
        return None, refused
    steps = {mrad: curves[f"{mrad:g}"] for mrad in STEPS_MRAD if f"{mrad:g}" in curves}
    count_rad = 2.0 * math.pi / config.encoder.counts_per_turn
    noise_rad = known_noise(gains, count_rad) if gains else None
    return tracking(curves["paper"], steps, count_rad, encoder_rms_rad=noise_rad), refused


@contextlib.contextmanager
def _enabled(axis: AxisClient) -> Iterator[None]:
    """The axis enabled for what is measured, and as it was behind it; stopped before anything else when that fails."""
    was_enabled = axis.status().enabled
    try:
        if not was_enabled:
            axis.enable()
            axis.wait(REST_S)
        yield
    except BaseException:
        axis.stop()
        raise
    finally:
        if not was_enabled:
            axis.disable()


def _recorded(axis: AxisClient, on_progress: Callable[[float], None]) -> tuple[dict[str, Curves], list[str]]:
    """Curves by motion, "paper" or a step's size in mrad, and the motions that the daemon refused with its reason."""
    motions = {"paper": ReferenceMotion.paper(PAPER_S)}
    motions |= {f"{mrad:g}": ReferenceMotion.step(1e-3 * mrad, HOLD_S) for mrad in STEPS_MRAD}
    curves: dict[str, Curves] = {}
    refused: list[str] = []
    for index, (name, motion) in enumerate(motions.items()):
        on_progress(index / len(motions))
        start_rad = axis.status().reference_rad
        try:
            curves[name] = curves_of(axis.run(motion), start_rad)
        except (
            Refused,
            RemoteBadInput,
        ) as error:  # of an enabled axis: the motion is too much for its limits
            refused.append(f"{name}: {error}")
    return curves, refused


def _require_active(axis: AxisClient, deployed: tuple[str, int]) -> None:
    """What is measured is what was deployed. Raises AnswerIsNo."""
    if axis.active == deployed:
        return
    (runs, runs_version), (name, version) = axis.active, deployed
    raise AnswerIsNo(
        f"the axis runs {runs} version {runs_version}, but {name} version {version} was deployed; to measure that, "
        f"`servoctl gains activate {name} --version {version}`"
    )


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
    active = read_json(walk.path(DEPLOYMENT))["gains"]
    deployed, gains = (active["name"], active["version"]), load_gains(walk.path(GAINS))
    with walk.progress(title) as on_progress:
        tracking, missing = measure_on_daemon(
            axis.socket, axis.config, deployed, partial(on_progress, "deployed law"), gains
        )
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
    with walk.progress(title) as on_progress:
        figures = measured(walk, axis, sets, deployed.design.velocity_cutoff_hz, on_progress)
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
    figures = tuning.get(feedback.value, {}).get(name, {})
    return {"tuned": name != DEPLOYED} | {key: figures[key] for key in ROUGHNESS if key in figures}
