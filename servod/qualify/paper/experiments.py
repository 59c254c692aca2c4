"""What is done on a virtual axis over the whole CAN loop, SYNC-stepped: identify, design, track and step.

Jobs of the pool: plain values in and out. An axis that refuses or faults is a result, not an error: the paper's own
numbers may trip it.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servod.client.axis import ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.common.errors import AnswerIsNo
from servod.common.faults import Reaction, faults_in
from servod.formats.gains.gain_set import GainSet
from servod.formats.model.axis_model import AxisModel
from servod.lab.identify.fits.presliding import PreslidingFit
from servod.lab.identify.result import model_of
from servod.lab.identify.walk import identify
from servod.lab.report.figures.motion import PlottedMotion
from servod.lab.synthesize.deployed import Wishes
from servod.lab.synthesize.gain_set import DesignOptions, synthesize
from servod.lab.synthesize.infeasible import Infeasible
from servod.lab.synthesize.regions import uncertainty_of
from servod.lab.tracking.metrics import Curves, StepResponse, Tracking, roughness, score, step_response
from servod.lab.tracking.stepped import activate, run_motion
from servod.lab.tune.plan import Feedback, TuningSettings
from servod.lab.tune.rivals import tuned_in_turn
from servod.qualify.paper.joints import CUTOFF_HZ, ENCODER_COUNTS, PaperJoint, open_axis, open_for_tracking
from servod.qualify.paper.printed import STEPS_MRAD

COUNT_RAD = 2.0 * np.pi / ENCODER_COUNTS


@dataclass(frozen=True)
class Found:
    """One joint identified and designed for; `presliding` is None where it was not identified but told."""

    model: AxisModel
    gains: GainSet
    presliding: PreslidingFit | None


@dataclass(frozen=True)
class Measured:
    """Motions of one gain set on one joint. What the axis stopped is missing; `stops` says why, by motion."""

    label: str
    followed: PlottedMotion | None
    steps: dict[float, PlottedMotion]
    responses: dict[float, StepResponse]
    stops: dict[str, str]

    def tracking(self) -> Tracking | None:
        """Figures of merit, by the rules of servod.lab.tracking; None where (19) was not followed to its end."""
        if self.followed is None:
            return None
        error = score(self.followed.time_s, self.followed.error_mrad)
        rough = roughness(self.followed.time_s, self.followed.torque_nm)
        return Tracking(error.rms_error_mrad, error.max_error_mrad, rough, self.responses)


def identify_and_design(joint: PaperJoint, seed: int) -> Found:
    """Walk through the identification of `joint`, then synthesize for what was found. Raises AnswerIsNo."""
    with tempfile.TemporaryDirectory(prefix="servod-paper-") as folder:
        axis = open_axis(joint, Path(folder), seed)
        analysis = identify(axis, Path(folder) / "recordings", lambda _what, _share: None, seed=seed)
    model = model_of(analysis)
    return Found(model, design(model), analysis.presliding)


def design_for_model(joint: PaperJoint) -> Found:
    """`joint` designed for by its own model, without an identification: what a quick look takes. Raises AnswerIsNo."""
    model = joint.model()
    return Found(model, design(model), None)


def design(model: AxisModel) -> GainSet:
    """The gain set that a deployment would begin with, designed for `model`; it is measured here, not certified.

    Raises AnswerIsNo when there is none.
    """
    wishes = Wishes(uncertainty=uncertainty_of(model), counts_per_turn=ENCODER_COUNTS)
    gains = synthesize(model, wishes, DesignOptions("deployed"))
    if isinstance(gains, Infeasible):
        raise AnswerIsNo("no design for the identified joint: " + "; ".join(gains.clashes or gains.regions))
    return gains


def cutoff_of(gains: GainSet) -> float:
    """The velocity filter that a set was designed for, or the paper's sets' own."""
    return gains.design.velocity_cutoff_hz if gains.design else CUTOFF_HZ


def measure(
    joint: PaperJoint, label: str, gains: GainSet, cutoff_hz: float, seed: int, seconds: float, hold_s: float
) -> Measured:
    """Trajectory (19) for `seconds`, then each step on an axis of its own, held for `hold_s` (0: no steps)."""
    stops: dict[str, str] = {}
    followed = _motion(joint, label, gains, cutoff_hz, seed, ReferenceMotion.paper(seconds), "(19)", stops)
    steps = {
        size: _motion(
            joint, label, gains, cutoff_hz, seed, ReferenceMotion.step(size * 1e-3, hold_s), f"{size:g} mrad", stops
        )
        for size in (STEPS_MRAD if hold_s else ())
    }
    done = {size: motion for size, motion in steps.items() if motion is not None}
    responses = {s: step_response(m.time_s, m.position_rad, s * 1e-3, COUNT_RAD) for s, m in done.items()}
    return Measured(label, followed, done, responses, stops)


def _motion(
    joint: PaperJoint,
    label: str,
    gains: GainSet,
    cutoff_hz: float,
    seed: int,
    motion: ReferenceMotion,
    name: str,
    stops: dict[str, str],
) -> PlottedMotion | None:
    """One motion on a fresh axis; None, and the reason in `stops`, when the axis did not stand it."""
    with tempfile.TemporaryDirectory(prefix="servod-paper-") as folder:
        axis = open_for_tracking(joint, Path(folder), seed, cutoff_hz)
        try:
            activate(axis, gains)
            return motion_of_curves(label, run_motion(axis, motion))
        except AnswerIsNo as error:
            stops[name] = _why(axis) or str(error)
            return None


def _why(axis: SteppedAxis) -> str:
    """The faults that stopped the axis, by name; not those that only clip or tell."""
    found = faults_in(axis.session.latest.faults_latched)
    return ", ".join(fault.code.name for fault in found if fault.reaction > Reaction.CLIP)


def motion_of_curves(label: str, c: Curves) -> PlottedMotion:
    """A measured motion as the figures take it."""
    return PlottedMotion(label, c.time_s, c.reference_rad, c.position_rad, c.torque_nm, c.friction_nm)


# --- The fair comparison ---------------------------------------------------------------------------------------------
# Every law tuned by the same rules on the identified joint, then measured on the joint itself: the fair comparison.
# Tuning sees the model and its intervals, scoring the plant, with other seeds.


#: What people read, by the rival's key in servod.lab.tune.laws.RIVALS.
LABELS = {
    "pd": "PD",
    "pd_dob": "PD + DOB",
    "pd_lugre": "PD + LuGre, l_f tuned",
    "pd_lugre_025": "PD + LuGre, l_f 0.25",
    "pd_lugre_035": "PD + LuGre, l_f 0.35",
    "local": "local",
}
#: Rivals by the law that they run: one job tunes those of a law, for they start from each other.
FAMILIES = (("pd",), ("pd_dob",), ("pd_lugre", "pd_lugre_025", "pd_lugre_035"), ("local",))
#: Between the seeds of tuning and of scoring.
SCORING_SEED_OFFSET = 100


@dataclass(frozen=True)
class Contender:
    """One tuned law: what people read of it, its class, and what it did on the joint."""

    law: str
    feedback: Feedback
    measured: Measured


def tuned_sets(
    model: AxisModel, names: tuple[str, ...], cutoff_hz: float, seed: int
) -> dict[tuple[Feedback, str], GainSet]:
    """The rivals `names`, which share one law and its budget, in both classes, tuned for `model` in its intervals."""
    plan = TuningSettings(seed=seed, counts_per_turn=float(ENCODER_COUNTS), cutoff_hz=cutoff_hz)
    return {key: found.gains for key, found in tuned_in_turn(model, names, plan).items()}


def score_rival(
    joint: PaperJoint, name: str, feedback: Feedback, gains: GainSet, cutoff_hz: float, seed: int, seconds: float
) -> Contender:
    """Track (19) with one tuned set over the whole CAN loop."""
    label = f"{LABELS[name]}, {feedback.value} feedback"
    found = measure(joint, label, gains, cutoff_hz, seed + SCORING_SEED_OFFSET, seconds, 0.0)
    return Contender(LABELS[name], feedback, found)
