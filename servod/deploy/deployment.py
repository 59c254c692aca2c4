"""The trial of a gain set on an axis: the same motion before and after the change, a verdict, and the way back.

Above link and judge. However it ends (verdict, fault, Ctrl-C), the set that runs afterwards is one that was meant to:
the new one when it proved itself, else the one of before.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.config import AxisConfig
from servod.deploy.judge import complaints, promise_document
from servod.deploy.links import DeployLink, Rows
from servod.errors import FAULTS, AnswerIsNo, BadInput, Reaction, ServodError, faults_in
from servod.gain_design import Design
from servod.gains import GainSet, Promise, require_certificate, require_same_loop
from servod.verify.validation import Figures, ValidationMotion, motion_for

#: Told what is done, and the share of the whole that is.
Tell = Callable[[str, float], None]

#: The joint may be so many times the motion's travel away from the reference; at most this share of the limit.
WINDOW_TRAVELS, WINDOW_SHARE = 3.0, 0.85
#: A value that is limited in no more than this share of the sines' cycles says nothing against a set: one cycle in a
#: reversal of coarse counts, or as long as an offset fades. What it does to the motion is in the figures.
FEW_LIMITED = 0.002
#: Where the set of before met the limit as well it is low for the motion, and twice as often may be chance; but no more
#: than so much more often, and never more than the most, where that set did not either.
MORE_LIMITED, MOST_LIMITED = 0.01, 0.05
#: Faults that say that a value had to be limited.
_CLIPS = sum(fault.bit for fault in FAULTS.values() if fault.reaction == Reaction.CLIP)


@dataclass(frozen=True)
class Deployment:
    """How a deployment ended. `stays`: the new set runs; else the one before does, and `reasons` say why."""

    stays: bool
    reasons: tuple[str, ...]
    name: str
    version: int
    present: tuple[str, int]
    promised: Promise
    before: Figures
    after: Figures | None
    rows_before: Rows
    rows_after: Rows | None

    def document(self) -> dict[str, Any]:
        """Plain values, figures in mrad."""
        return {
            "deployed": self.stays,
            "reasons": list(self.reasons),
            "gains": {"name": self.name, "version": self.version},
            "present": {"name": self.present[0], "version": self.present[1]},
            "before": self.before.document(),
            "after": self.after and self.after.document(),
            "promised": promise_document(self.promised),
        }


def deploy(link: DeployLink, gains: GainSet, tell: Tell) -> Deployment:
    """Try `gains` on the axis and keep it when it proves itself; the axis is left enabled or not, as it was.

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
        return trial.run(gains)
    except BaseException:
        link.stop()
        trial.abandon("it was interrupted")
        raise
    finally:
        if not was_enabled:
            link.disable()


def admitted(gains: GainSet, config: AxisConfig) -> tuple[Design, Promise]:
    """Design and promise of a set that may be tried on this axis. Raises BadInput."""
    require_certificate(gains, accept_uncertified=None)
    require_same_loop(gains, config)
    assert gains.certificate is not None
    if gains.design is None or gains.certificate.promised is None:
        raise BadInput(
            f"gain set {gains.name}: certificate.promised", "nothing", "a promise; `servoctl verify` writes it anew"
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

    def run(self, gains: GainSet) -> Deployment:
        """Before, change, after, verdict."""
        link, present = self._link, self._link.active
        rows_before = self._move("under the present set", 0.05)
        before = self._figures(rows_before)
        name, version = link.load(gains)
        if (name, version) != present:
            self._tell("change of the set", 0.48)
            self._on_trial = True
            link.attempt(name, version)
        rows_after, after, reasons = self._after(rows_before, before)
        self._end(before, after, reasons)
        return Deployment(
            stays=not reasons,
            reasons=tuple(reasons),
            name=name,
            version=version,
            present=present,
            promised=self._promised,
            before=before,
            after=after,
            rows_before=rows_before,
            rows_after=rows_after,
        )

    def abandon(self, why: str) -> None:
        """Back to the present set, when another one is on trial; a daemon goes back by itself when this client ends."""
        if self._on_trial:
            self._on_trial = False
            with contextlib.suppress(ServodError):
                self._link.give_up(why, {})

    def _after(self, rows_before: Rows, before: Figures) -> tuple[Rows | None, Figures | None, list[str]]:
        """The motion under the new set: cycles, figures, and what speaks against it."""
        try:
            rows = self._move("under the new set", 0.52)
        except AnswerIsNo as error:
            return None, None, [str(error)]
        try:
            after = self._figures(rows)
        except AnswerIsNo as error:
            return rows, None, [str(error)]
        limited = limits_met(motions_in(rows)[0], motions_in(rows_before)[0])
        reasons = [*limited, *complaints(before, after, self._promised, self._count_rad)]
        return rows, after, [*reasons, *(skipped(rows) if reasons else [])]

    def _end(self, before: Figures, after: Figures | None, reasons: list[str]) -> None:
        figures = {f"before_{key}": value for key, value in before.document().items()}
        figures |= {f"after_{key}": value for key, value in (after.document() if after else {}).items()}
        self._tell("verdict", 1.0)
        if not self._on_trial:
            return
        self._on_trial = False
        if reasons:
            self._link.give_up("; ".join(reasons)[:4000], figures)
        else:
            self._link.keep("proven by the validation motion", figures)

    def _move(self, what: str, share: float) -> Rows:
        self._tell(what, share)
        return self._link.run(self._motion, self._window_rad, lambda done: self._tell(what, share + 0.43 * done))

    def _figures(self, rows: Rows) -> Figures:
        """Raises AnswerIsNo when the motion was not run to its end."""
        parts = [_every_cycle(part) for part in motions_in(rows)]
        try:
            sines, up, down = parts
            return self._motion.figures(sines[0] - sines[1], (up[1], down[1]))
        except ValueError:
            raise AnswerIsNo(
                f"the joint left its window of {1e3 * self._window_rad:.3g} mrad around the reference"
            ) from None


def motions_in(rows: Rows) -> list[Rows]:
    """The stretches of `rows` in which a reference motion ran."""
    edges = np.flatnonzero(np.diff(rows["reference_active"] == 1, prepend=False, append=False))
    return [rows[start:end] for start, end in zip(edges[::2], edges[1::2], strict=True)]


def limits_met(rows: Rows, before: Rows) -> list[str]:
    """What had to be limited in these sines, by the table of faults; a step may be limited.

    Not what few cycles met, and not what the set `before` met about as often: then the limit is too low for the motion.
    """
    found = []
    for fault in faults_in(int(np.bitwise_or.reduce(rows["faults"])) & _CLIPS):
        share, earlier = (float(np.mean((of["faults"] & fault.bit) != 0)) for of in (rows, before))
        if share > limited_at_most(earlier):
            found.append(f"{fault.code.name} in {100.0 * share:.2g} % of the cycles: {fault.cause}")
    return found


def limited_at_most(earlier: float) -> float:
    """Share of cycles that may be limited where it was `earlier` under the set of before; at least as much as that."""
    return max(FEW_LIMITED, earlier, min(2.0 * earlier, earlier + MORE_LIMITED, MOST_LIMITED))


def skipped(rows: Rows) -> list[str]:
    """What a loop that does not keep time makes doubtful."""
    missed, cycles = int(rows["missed"][-1] - rows["missed"][0]), int(rows["cycle"][-1] - rows["cycle"][0])
    if not missed:
        return []
    return [
        f"the loop skipped {missed} of {cycles} cycles, and no promise holds then: see `servoctl bench`, and try again"
    ]


def _every_cycle(rows: Rows) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(reference, position) at every cycle; cycles that the loop skipped are put between their neighbours."""
    cycle = rows["cycle"] - rows["cycle"][0]
    every = np.arange(int(cycle[-1]) + 1)
    return np.interp(every, cycle, rows["reference_rad"]), np.interp(every, cycle, rows["position_rad"])
