"""The steps of a commissioning in order: each is done once for what it is made from, whatever interrupts the walk.

Above the steps, below `servoctl commission`. A step reads and writes files in the walk's folder and nothing else, so
that the walk can be taken up by another process.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from servod.client.open import WalkAxis
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.progress import OnProgress
from servod.lab.commission.state import State, file_sha256, sole_walk

# --- Questions to a person -------------------------------------------------------------------------------------------
# What a person must decide, and who answers when nobody is there. A step asks before it does what cannot be undone or
# was not asked for.


#: Puts a yes-or-no question to a person.
Put = Callable[[str], bool]


@dataclass(frozen=True)
class Questions:
    """`yes` answers everything with yes. Without it a person is asked, when there is one."""

    yes: bool
    put: Put
    person: Callable[[], bool] = lambda: sys.stdin.isatty() and sys.stderr.isatty()

    def agree(self, question: str) -> None:
        """Go on only with a yes. Raises AnswerIsNo on a no, BadInput when nobody can answer."""
        if self.yes:
            return
        if not self.person():
            raise BadInput("standard input", "no terminal to ask at", f"--yes, which agrees to: {question}")
        if not self.put(question):
            raise AnswerIsNo(f"not agreed: {question}")

    def takes(self, offer: str) -> bool:
        """Whether an offer is taken; with nobody to ask it is not."""
        return self.yes or (self.person() and self.put(offer))


#: Opens the progress of one step, by its title.
Progress = Callable[[str], AbstractContextManager[OnProgress]]


#: From the seed of excitation and virtual noise to those of scoring and of tuning. A seed begins the noise of joint and
#: encoder as itself and the next number, one of tuning that of its plants as its thousandfold and the next ones.
SCORING_SEED, TUNING_SEED = 100, 200


@dataclass(frozen=True)
class WalkOptions:
    """What may be chosen of a walk. No law is scored under noise that it was tuned in, or identified for."""

    seed: int = 1
    travel_rad: float | None = None
    speed_rad_s: float | None = None
    accuracy: float = 0.02
    plants: int = 1000
    budget: int | None = None  # of each rival's tuning; None = the tuning's own
    rivals: bool = True
    processes: int = 2
    least_plants: int = 1000  # with fewer no certificate is issued
    again: tuple[str, ...] = ()  # steps that are done again, whatever was done before

    @property
    def tuning_seed(self) -> int:
        """Begins plants, noise and search of the rivals' tuning."""
        return self.seed + TUNING_SEED

    @property
    def scoring_seed(self) -> int:
        """Begins the noise of the comparison on the axis."""
        return self.seed + SCORING_SEED


@dataclass(frozen=True)
class Walk:
    """What every step is given."""

    folder: Path
    axis: WalkAxis
    options: WalkOptions
    questions: Questions
    progress: Progress
    say: Callable[[str], None]

    def path(self, name: str) -> Path:
        """A file in the folder."""
        return self.folder / name

    def hashes(self, *names: str) -> dict[str, str]:
        """Hashes of files in the folder by their names."""
        return {name: file_sha256(self.path(name)) for name in names}


class Step(Protocol):
    """One step: `inputs` are plain values that decide what comes out."""

    @property
    def name(self) -> str:
        """Its key in the state."""
        ...

    @property
    def title(self) -> str:
        """What people read."""
        ...

    def outputs(self, walk: Walk) -> tuple[str, ...]:
        """Files in the walk's folder that are there when it is done, and that nobody else writes."""
        ...

    def inputs(self, walk: Walk) -> dict[str, Any]:
        """Everything that the result depends on."""
        ...

    def run(self, walk: Walk) -> None:
        """Do it. Raises as the parts do; files come aside first, then under their names."""
        ...


# How long a walk still takes: what its steps usually take, corrected by what those took that have ended here.


#: Seconds of a step on a virtual axis, roughly: the first guess, whose proportions alone are believed later.
_USUAL_S = {
    "identify": 40.0, "synthesize": 30.0, "verify": 30.0, "deploy": 10.0, "rivals": 90.0, "validate": 30.0,
    "report": 10.0,
}  # fmt: skip
#: A step that nobody has timed.
_UNKNOWN_S = 20.0
#: A step's own share of progress is believed from here on.
_BELIEVED_SHARE = 0.1


@dataclass
class Outlook:
    """The seconds that are left, from the steps that ended and the share of the one that runs.

    `earlier` are the seconds that steps took when they were done in this folder before, by name.
    """

    names: tuple[str, ...]
    earlier: Mapping[str, float] = field(default_factory=dict)
    now_s: Callable[[], float] = time.monotonic
    _here: int = 0
    _began_s: float = 0.0
    _taken_s: float = 0.0
    _usual_s: float = 0.0

    def begin(self, name: str) -> str:
        """A step begins; which one of how many it is, in words."""
        self._here, self._began_s = self.names.index(name), self.now_s()
        return f"step {self._here + 1} of {len(self.names)}"

    def end(self) -> None:
        """It was done; what it took corrects what is expected of the others."""
        self._taken_s += self.now_s() - self._began_s
        self._usual_s += self._usual(self._here)

    def left_s(self, share: float = 0.0) -> float:
        """Of this step, of which `share` is done, and of those behind it."""
        pace = self._taken_s / self._usual_s if self._usual_s else 1.0
        spent_s = self.now_s() - self._began_s
        believed = _BELIEVED_SHARE <= share <= 1.0
        whole_s = spent_s / share if believed else pace * self._usual(self._here)
        behind_s = sum(self._usual(k) for k in range(self._here + 1, len(self.names)))
        return max(whole_s - spent_s, 0.0) + pace * behind_s

    def left(self, share: float = 0.0) -> str:
        """The same in words: it is a guess."""
        left_s = self.left_s(share)
        return f"about {round(left_s / 60.0)} min left" if left_s >= 90.0 else f"about {max(left_s, 1.0):.0f} s left"

    def _usual(self, step: int) -> float:
        name = self.names[step]
        return self.earlier.get(name, _USUAL_S.get(name, _UNKNOWN_S))


def with_outlook(walk: Walk, outlook: Outlook, where: str) -> Walk:
    """The walk as a step sees it whose progress says which step this is and how long the walk still takes."""

    @contextmanager
    def progress(title: str) -> Iterator[OnProgress]:
        with walk.progress(title) as on_progress:
            yield lambda what, share: on_progress(f"{what} ({where}, {outlook.left(share)})", share)

    return replace(walk, progress=progress)


class StepFailed(AnswerIsNo):
    """A step's answer was no; carries the step's name."""

    def __init__(self, step: str, message: str) -> None:
        super().__init__(message)
        self.step = step


def run(walk: Walk, steps: tuple[Step, ...]) -> State:
    """Do every step that is not done yet, in order; the state then has those that ended.

    Raises StepFailed when a step's answer is no, BadInput on a file that was edited, else as the steps do.
    """
    names = [step.name for step in steps]
    for name in walk.options.again:
        if name not in names:
            raise BadInput("--again", name, ", ".join(names))
    with sole_walk(walk.folder):
        state = State(walk.folder, walk.axis.identity, [name for step in steps for name in step.outputs(walk)])
        outlook = Outlook(tuple(names), state.seconds)
        for step in steps:
            inputs, where = step.inputs(walk), outlook.begin(step.name)
            if step.name not in walk.options.again and state.done(step.name, inputs, step.outputs(walk)):
                walk.say(f"{where}: {step.title}: done before")
                continue
            state.begin(step.name, step.outputs(walk))
            walk.say(f"{where}: {step.title}, {outlook.left()}")
            started = time.monotonic()
            try:
                step.run(with_outlook(walk, outlook, where))
            except AnswerIsNo as error:
                raise StepFailed(step.name, str(error)) from error
            state.record(step.name, inputs, time.monotonic() - started, step.outputs(walk))
            outlook.end()
            walk.say(f"{where}: {step.title}: {state.seconds[step.name]:.1f} s")
    return state
