"""What a person must decide, and who answers when nobody is there.

Beside the walk; a step asks before it does what cannot be undone or was not asked for.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass

from servod.common.errors import AnswerIsNo, BadInput

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
