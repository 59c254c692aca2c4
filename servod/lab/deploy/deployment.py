"""The trial of a gain set on an axis: the same motion before and after the change, a verdict, and the way back.

Above link and judge. However it ends (verdict, fault, Ctrl-C), the set that runs afterwards is one that was meant to:
the new one when it proved itself, else the one of before.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np

from servod.client.stepped import DeployLink, Rows
from servod.common.errors import AnswerIsNo, BadInput, ServodError
from servod.formats.config import AxisConfig
from servod.formats.gains.design import Design
from servod.formats.gains.gain_set import GainSet, Promise, require_certificate, require_same_loop
from servod.lab.deploy.judge import complaints, every_cycle, limits_met, motions_in, skipped
from servod.lab.deploy.outcome import Before, Deployment, Ending
from servod.lab.verify.validation import Figures, ValidationMotion, motion_for

#: Told what is done, and the share of the whole that is.
Tell = Callable[[str, float], None]

#: How a trial ended, by whether the set ran already and whether it proved itself.
_ENDINGS = {
    (False, True): Ending.KEPT,
    (False, False): Ending.ROLLED_BACK,
    (True, True): Ending.CONFIRMED,
    (True, False): Ending.DOUBTED,
}
#: Characters of a note in the store's history.
_LONGEST_NOTE = 4000
#: The joint may be so many times the motion's travel away from the reference; at most this share of the limit.
WINDOW_TRAVELS, WINDOW_SHARE = 3.0, 0.85


def deploy(
    link: DeployLink,
    gains: GainSet,
    tell: Tell,
    earlier: Before | None = None,
    remember: Callable[[Before], None] = lambda _before: None,
) -> Deployment:
    """Try `gains` on the axis and keep it when it proves itself; the axis is left enabled or not, as it was.

    A set that is active already is not on trial: it runs the motion once and runs on, whatever comes out. What it is
    compared with is then `earlier`, the motion before it became active, which `remember` was given at that time; where
    there is none its promise alone judges.

    Raises BadInput when the set is not certified, promises nothing or is for another loop, AnswerIsNo when the axis
    does not get through the motion under its present set. An interrupt stops the axis, leaves it off and the present
    set active.
    """
    design, promised = admitted(gains, link.config)
    motion = motion_for(design)
    window_rad = min(WINDOW_TRAVELS * motion.travel_rad, WINDOW_SHARE * link.config.limits.following_error_rad)
    was_enabled = link.enabled
    trial = _Trial(link, motion, window_rad, promised, tell)
    try:
        if not was_enabled:
            tell("enable", 0.0)
            link.enable()
        return trial.run(gains, earlier, remember)
    except BaseException as error:
        link.stop()
        trial.abandon(str(error) if isinstance(error, ServodError) else "it was interrupted")
        raise
    finally:
        if not was_enabled:
            link.disable()


def admitted(gains: GainSet, config: AxisConfig, where: str | None = None) -> tuple[Design, Promise]:
    """Design and promise of a set that may be tried on this axis. Raises BadInput; `where` is the file, if any."""
    require_certificate(gains, accept_uncertified=None, where=where)
    require_same_loop(gains, config, where)
    assert gains.certificate is not None
    if gains.design is None or gains.certificate.promised is None:
        raise BadInput(
            f"{where or 'gain set ' + gains.name}: certificate.promised",
            "nothing",
            "a promise; `servoctl verify` writes it anew",
        )
    return gains.design, gains.certificate.promised


def announced(gains: GainSet) -> str:
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
        self, link: DeployLink, motion: ValidationMotion, window_rad: float, promised: Promise, tell: Tell
    ) -> None:
        self._link, self._motion, self._window_rad = link, motion, window_rad
        self._promised, self._tell = promised, tell
        self._count_rad = 2.0 * np.pi / link.config.encoder.counts_per_turn
        self._on_trial = False

    def run(self, gains: GainSet, earlier: Before | None, remember: Callable[[Before], None]) -> Deployment:
        """Before, change, after, verdict."""
        present, (name, version) = self._link.active, self._link.load(gains)
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
                self._link.give_up(why[:_LONGEST_NOTE], {})

    def _before(
        self, present: tuple[str, int], earlier: Before | None, ran_already: bool
    ) -> tuple[Before | None, Figures | None]:
        """The motion before the change and its figures: run now, or `earlier` when the change is past."""
        ran = earlier if ran_already else Before(present, self._move("under the present set", 0.05))
        return (ran, self._figures(ran.rows)) if ran else (None, None)

    def _after(
        self, change: tuple[str, int] | None, ran_before: Before | None, before: Figures | None
    ) -> tuple[Rows | None, Figures | None, list[str]]:
        """Change to the new set, unless it runs, and its motion: cycles, figures, and what speaks against it."""
        try:
            if change:
                self._tell("change of the set", 0.48)
                self._on_trial = True
                self._link.attempt(*change)
            rows = self._move("under the new set", 0.52)
        except AnswerIsNo as error:
            return None, None, [str(error)]
        try:
            after = self._figures(rows)
        except AnswerIsNo as error:
            return rows, None, [str(error)]
        limited = limits_met(motions_in(rows)[0], motions_in(ran_before.rows)[0] if ran_before else None)
        reasons = [*limited, *complaints(before, after, self._promised, self._count_rad)]
        return rows, after, [*reasons, *(skipped(rows) if reasons else [])]

    def _end(self, before: Figures | None, after: Figures | None, reasons: list[str]) -> None:
        told = {"before": before, "after": after}
        figures = {f"{when}_{key}": value for when, of in told.items() if of for key, value in of.document().items()}
        self._tell("verdict", 1.0)
        if not self._on_trial:
            return
        if reasons:
            self._link.give_up("; ".join(reasons)[:_LONGEST_NOTE], figures)
        else:
            self._link.keep("proven by the validation motion", figures)
        self._on_trial = False

    def _move(self, what: str, share: float) -> Rows:
        self._tell(what, share)
        return self._link.run(self._motion, self._window_rad, lambda done: self._tell(what, share + 0.43 * done))

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
