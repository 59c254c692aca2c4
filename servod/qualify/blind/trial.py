"""What a trial is: its settings and the hash of its sealed truth, in one file of its folder.

Under the three processes; each reads it, only the first writes it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from servod import __version__
from servod.common.errors import BadInput
from servod.common.files import read_json
from servod.common.report_files import write_bytes

FILE = "trial.json"
_ALLOWED = "what `servoctl prove` wrote"


@dataclass(frozen=True)
class Trial:
    """The cases of a trial: how many, by which seed, whether the harder ones; and the hash of the sealed truth."""

    cases: int
    seed: int
    harder: bool
    sha256: str = ""
    version: str = __version__

    def same(self, other: Trial) -> bool:
        """Whether both draw the same cases."""
        return (self.cases, self.seed, self.harder) == (other.cases, other.seed, other.harder)


def write_trial(out: Path, trial: Trial) -> None:
    """Write the trial's file. Raises BadInput."""
    write_bytes(out / FILE, (json.dumps(asdict(trial)) + "\n").encode())


def read_trial(out: Path) -> Trial | None:
    """The trial in a folder, if any. Raises BadInput when its file is no such file."""
    path = out / FILE
    if not path.exists():
        return None
    try:
        return Trial(**read_json(path, _ALLOWED))
    except TypeError:
        raise BadInput(str(path), "other keys than a trial has", _ALLOWED) from None
