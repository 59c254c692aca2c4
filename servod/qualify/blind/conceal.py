"""Writes the cases of a trial: folders with a model and recordings, and apart from them the truth, sealed by its hash.

The first of the three processes. The hash is told before anybody diagnoses; the truth contains a random number, so that
nobody finds it by trying seeds. What is sealed cannot be read until it is scored, unless its owner allows it again.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from servod import __version__
from servod.common.errors import BadInput
from servod.common.files import read_json, write_bytes
from servod.qualify.blind.case import Case, make_case
from servod.qualify.blind.plan import Plan, Settings

#: Told how many cases are made of how many.
Tell = Callable[[int, int], None]

CASES, SEALED, TRUTH, HOLDOUT = "cases", "sealed", "truth.json", "holdout"


def conceal(plans: Sequence[Plan], settings: Settings, out: Path, tell: Tell) -> str:
    """Write folders into `out`/cases and the truth into `out`/sealed; returns the truth's SHA-256."""
    truths = {}
    for number, plan in enumerate(plans):
        name = f"c{number:03d}"
        case = make_case(plan, settings)
        truths[name] = case.truth
        write_case(case, out / CASES / name, out / SEALED / name)
        tell(number + 1, len(plans))
    whole = {"salt": secrets.token_hex(16), "cases": truths}
    content = (json.dumps(whole, indent=1, allow_nan=False) + "\n").encode()
    write_bytes(out / SEALED / TRUTH, content)
    lock(out)
    return hashlib.sha256(content).hexdigest()


def open_cases(plans: Sequence[Plan], settings: Settings, out: Path, tell: Tell) -> None:
    """Write folders with everything in them, truth.yaml as well, for whoever develops a diagnosis."""
    for number, plan in enumerate(plans):
        case = make_case(plan, settings)
        folder = out / f"c{number:03d}"
        write_case(case, folder, folder)
        write_bytes(folder / "truth.yaml", yaml.safe_dump(case.truth, sort_keys=False).encode())
        tell(number + 1, len(plans))


def write_case(case: Case, folder: Path, held: Path) -> None:
    """Model and recordings into `folder`, the recording that is held out into `held`."""
    write_bytes(folder / "model.yaml", yaml.safe_dump(case.model, sort_keys=False).encode())
    for name, columns in case.recordings.items():
        where = held if name == HOLDOUT else folder
        write_bytes(where / f"{name}.csv.gz", packed(columns))


def packed(columns: Mapping[str, NDArray[np.float64]]) -> bytes:
    """Columns as compressed CSV with nine digits; the same columns give the same bytes."""
    import pyarrow as pa
    import pyarrow.csv as pc

    table = pa.table({name: _rounded(values) for name, values in columns.items()})
    plain = io.BytesIO()
    plain.write((",".join(columns) + "\n").encode())
    pc.write_csv(table, plain, pc.WriteOptions(include_header=False))
    return gzip.compress(plain.getvalue(), 1, mtime=0)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    largest = float(np.max(np.abs(values)))
    digits = 9 - (int(np.ceil(np.log10(largest))) if largest > 0.0 else 0)
    return np.round(values, digits)


def lock(out: Path) -> None:
    """Take from everybody the right to read what is sealed in `out`."""
    _allow(out, 0)


def unlock(out: Path) -> None:
    """Give it back to the owner."""
    _allow(out, 0o600)


def _allow(out: Path, mode: int) -> None:
    """Files, not their folder: whoever made a trial can still remove it."""
    for path in (out / SEALED).rglob("*"):
        if path.is_file():
            path.chmod(mode)


def read_truth(out: Path, digest: str) -> dict[str, Any]:
    """Open the seal: the truth of all cases. Raises ValueError when it is not the truth that was sealed."""
    unlock(out)
    content = (out / SEALED / TRUTH).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != digest:
        raise ValueError(f"{out / SEALED / TRUTH} has SHA-256 {found}, sealed was {digest}")
    cases: dict[str, Any] = json.loads(content)["cases"]
    return cases


# What a trial is: its settings and the hash of its sealed truth, in one file of its folder.
#
# Under the three processes; each reads it, only the first writes it.


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
