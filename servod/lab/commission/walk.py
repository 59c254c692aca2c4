"""The steps of a commissioning in order: each is done once for what it is made from, whatever interrupts the walk.

Above the steps, below `servoctl commission`. A step reads and writes files in the walk's folder and nothing else, so
that the walk can be taken up by another process.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from servod.client.open import WalkAxis
from servod.common.errors import AnswerIsNo, BadInput
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


#: Told what a step does, and the share of it that is done.
Tell = Callable[[str, float], None]
#: Opens the progress of one step, by its title.
Progress = Callable[[str], AbstractContextManager[Tell]]


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
    again: tuple[str, ...] = ()  # steps that are done anew, whatever was done before

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
        for step in steps:
            inputs = step.inputs(walk)
            if step.name not in walk.options.again and state.done(step.name, inputs, step.outputs(walk)):
                walk.say(f"{step.title}: done before")
                continue
            state.begin(step.name, step.outputs(walk))
            started = time.monotonic()
            try:
                step.run(walk)
            except AnswerIsNo as error:
                raise StepFailed(step.name, str(error)) from error
            state.record(step.name, inputs, time.monotonic() - started, step.outputs(walk))
            walk.say(f"{step.title}: {state.seconds[step.name]:.1f} s")
    return state
