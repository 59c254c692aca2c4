"""The trial of a gain set on an axis: the same motion before and after the change, a verdict, and the way back.

Above the axis and the judge. However it ends (verdict, fault, Ctrl-C), the set that runs afterwards is one that was
meant to: the new one when it proved itself, else the one of before.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from servod.client.axis import AxisClient, ReferenceMotion
from servod.common.errors import AnswerIsNo, BadInput, ServodError
from servod.common.progress import OnProgress
from servod.formats.config import AxisConfig
from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Promise, require_certificate, require_same_loop
from servod.lab.deploy.judge import doubtful_timing, every_cycle, limits_met, motions_in, rejections
from servod.lab.deploy.outcome import Baseline, Deployment, Ending
from servod.lab.recordings.recording import Rows, rows_of
from servod.lab.verify.validation import STEP_S, Figures, ValidationMotion, motion_for

#: How a trial ended, by whether the set ran already and whether it proved itself.
_ENDINGS = {
    (False, True): Ending.KEPT,
    (False, False): Ending.ROLLED_BACK,
    (True, True): Ending.CONFIRMED,
    (True, False): Ending.DOUBTED,
}
#: After a change of the set, until its offset has faded out.
FADE_S = 1.0
#: Between two looks at a motion in virtual time.
_LOOK_S = 0.25
#: The sines may be short by so many cycles at their ends and still be whole: a record of the first may be late.
_CUT_CYCLES = 50
#: Characters of a note in the store's history.
_LONGEST_NOTE = 4000
#: The joint may be so many times the motion's travel away from the reference; at most this share of the limit.
WINDOW_TRAVELS, WINDOW_SHARE = 3.0, 0.85


def deploy(
    axis: AxisClient,
    gains: GainSet,
    on_progress: OnProgress,
    earlier: Baseline | None = None,
    remember: Callable[[Baseline], None] = lambda _before: None,
) -> Deployment:
    """Try `gains` on the axis and keep it when it proves itself; the axis is left enabled or not, as it was.

    A set that is active already is not on trial: it runs the motion once and runs on, whatever comes out. What it is
    compared with is then `earlier`, the motion before it became active, which `remember` was given at that time; where
    there is none its promise alone judges.

    Raises BadInput when the set is not certified, promises nothing or is for another loop, AnswerIsNo when the axis
    does not get through the motion under its present set. An interrupt stops the axis, leaves it off and the present
    set active.
    """
    design, promised = check_admissible(gains, axis.config)
    motion = motion_for(design)
    window_rad = min(WINDOW_TRAVELS * motion.travel_rad, WINDOW_SHARE * axis.config.limits.following_error_rad)
    was_enabled = axis.status().enabled
    trial = _Trial(axis, motion, window_rad, promised, on_progress)
    try:
        if not was_enabled:
            on_progress("enable", 0.0)
            axis.enable()
            axis.wait(FADE_S)
        return trial.run(gains, earlier, remember)
    except BaseException as error:
        axis.stop()
        trial.abandon(str(error) if isinstance(error, ServodError) else "it was interrupted")
        raise
    finally:
        if not was_enabled:
            axis.disable()


def check_admissible(gains: GainSet, config: AxisConfig, where: str | None = None) -> tuple[Design, Promise]:
    """Design and promise of a set that may be tried on this axis. Raises BadInput; `where` is the file, if any."""
    require_certificate(gains, accept_uncertified=None, where=where)
    require_same_loop(gains, config, where)
    assert gains.certificate is not None
    if gains.design is None or gains.certificate.promised is None:
        raise BadInput(
            f"{where or 'gain set ' + gains.name}: certificate.promised",
            "nothing",
            "a promise; `servoctl verify` writes it again",
        )
    return gains.design, gains.certificate.promised


def motion_notice(gains: GainSet) -> str:
    """How far, how fast and how long the axis will move in the trial of a set, for people. Raises BadInput."""
    if gains.design is None:
        raise BadInput(f"gain set {gains.name}: design", "nothing", "a design; `servoctl synthesize` makes it")
    motion = motion_for(gains.design)
    speed_rad_s = float(np.abs(np.diff(motion.sines)).max()) / motion.period_s
    return (
        f"sines and steps of up to {1e3 * motion.travel_rad:.3g} mrad to each side, sines at up to {speed_rad_s:.2g} "
        f"rad/s, {motion.duration_s:.0f} s under the present set and as long under the new one"
    )


class _Trial:
    """One trial: what it has done so far, so that it can be undone at any moment."""

    def __init__(
        self, axis: AxisClient, motion: ValidationMotion, window_rad: float, promised: Promise, on_progress: OnProgress
    ) -> None:
        self._axis, self._motion, self._window_rad = axis, motion, window_rad
        self._promised, self._on_progress = promised, on_progress
        self._count_rad = 2.0 * np.pi / axis.config.encoder.counts_per_turn
        self._on_trial = False

    def run(self, gains: GainSet, earlier: Baseline | None, remember: Callable[[Baseline], None]) -> Deployment:
        """Before, change, after, verdict."""
        present, (name, version) = self._axis.active, self._axis.load(gains)
        ran_already = present == (name, version)
        ran_before, before = self._before(present, earlier, ran_already)
        if ran_before and not ran_already:
            remember(ran_before)
        change = None if ran_already else (name, version)
        rows_after, after, reasons = self._after(change, ran_before, before)
        self._end(before, after, reasons)
        return Deployment(
            ending=_ENDINGS[ran_already, not reasons],
            reasons=tuple(reasons),
            name=name,
            version=version,
            promised=self._promised,
            before=before,
            after=after,
            ran_before=ran_before,
            rows_after=rows_after,
        )

    def abandon(self, why: str) -> None:
        """Back to the present set, when another one is on trial; a daemon goes back by itself when this client ends."""
        if self._on_trial:
            self._on_trial = False
            with contextlib.suppress(ServodError):
                self._axis.give_up(why[:_LONGEST_NOTE], {})

    def _before(
        self, present: tuple[str, int], earlier: Baseline | None, ran_already: bool
    ) -> tuple[Baseline | None, Figures | None]:
        """The motion before the change and its figures: run now, or `earlier` when the change is past."""
        ran = earlier if ran_already else Baseline(present, self._move("under the present set", 0.05))
        return (ran, self._figures(ran.rows)) if ran else (None, None)

    def _after(
        self, change: tuple[str, int] | None, ran_before: Baseline | None, before: Figures | None
    ) -> tuple[Rows | None, Figures | None, list[str]]:
        """Change to the new set, unless it runs, and its motion: cycles, figures, and what speaks against it."""
        try:
            if change:
                self._on_progress("change of the set", 0.48)
                self._activate(*change)
                self._axis.wait(FADE_S)
            rows = self._move("under the new set", 0.52)
        except AnswerIsNo as error:
            return None, None, [str(error)]
        try:
            after = self._figures(rows)
        except AnswerIsNo as error:
            return rows, None, [str(error)]
        limited = limits_met(motions_in(rows)[0], motions_in(ran_before.rows)[0] if ran_before else None)
        reasons = [*limited, *rejections(before, after, self._promised, self._count_rad)]
        return rows, after, [*reasons, *(doubtful_timing(rows) if reasons else [])]

    def _activate(self, name: str, version: int) -> None:
        """From here on the set is on trial, also where an interrupt cuts the request; a refusal leaves nothing to give
        up, which would only hide its reason."""
        self._on_trial = True
        try:
            self._axis.activate(name, version)
        except ServodError:
            self._on_trial = False
            raise

    def _end(self, before: Figures | None, after: Figures | None, reasons: list[str]) -> None:
        runs = {"before": before, "after": after}
        figures = {f"{when}_{key}": value for when, of in runs.items() if of for key, value in of.document().items()}
        self._on_progress("verdict", 1.0)
        if not self._on_trial:
            return
        if reasons:
            self._axis.give_up("; ".join(reasons)[:_LONGEST_NOTE], figures)
        else:
            self._axis.keep("proven by the validation motion", figures)
        self._on_trial = False

    def _move(self, what: str, share: float) -> Rows:
        self._on_progress(what, share)
        return run_validation(
            self._axis, self._motion, self._window_rad, lambda done: self._on_progress(what, share + 0.43 * done)
        )

    def _figures(self, rows: Rows) -> Figures:
        """Raises AnswerIsNo when the motion was not run to its end."""
        parts = [every_cycle(part) for part in motions_in(rows)]
        try:
            sines, up, down = parts
            return self._motion.figures(sines[0] - sines[1], (up[1], down[1]))
        except ValueError:
            raise AnswerIsNo(
                f"the joint left its window of {1e3 * self._window_rad:.3g} mrad around the reference"
            ) from None


def run_validation(
    axis: AxisClient,
    motion: ValidationMotion,
    window_rad: float,
    on_progress: Callable[[float], None] = lambda _done: None,
) -> Rows:
    """Run the motion from where the axis stands; all its cycles. `on_progress` gets the share that is done.

    The sines end when the joint is further than `window_rad` from the reference. Nothing follows them then: a law that
    lost the joint on a sine is given no step.
    """
    before_s = 0.0

    def watch(passed_s: float) -> None:
        on_progress(min(1.0, (before_s + passed_s) / motion.duration_s))

    sines = motion.sines.tolist()
    rows = rows_of(axis.run(ReferenceMotion.excite(sines, [0.0] * len(sines), window_rad), watch, _LOOK_S))
    if interrupted(rows, motion):
        return rows
    for step_rad in (motion.step_rad, -motion.step_rad):
        before_s = len(rows) * motion.period_s
        rows = np.concatenate([rows, rows_of(axis.run(ReferenceMotion.step(step_rad, STEP_S), watch, _LOOK_S))])
    return rows


def interrupted(rows: Rows, motion: ValidationMotion) -> bool:
    """Whether the reference of `rows`, which hold the sines alone, ended before the sines did."""
    ran = rows["cycle"][rows["reference_active"] == 1]
    return len(ran) == 0 or int(ran[-1]) - int(ran[0]) < len(motion.sines) - _CUT_CYCLES
