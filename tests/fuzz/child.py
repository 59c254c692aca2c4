"""Fuzzes one target in this process: what `tests.fuzz.run` starts, under limits that a bad input may hit.

    python -m tests.fuzz.child TARGET WAY FOLDER SECONDS

WAY is `bytes` (atheris gives the input), `shaped` (atheris gives the choices of the target's strategy) or `drawn`
(hypothesis draws alone). Crashes go to FOLDER/crashes, a line of figures to FOLDER/figures.json twice a second, so that
they are there even when an input kills the process.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded

from tests.fuzz.judge import ROOT, bound_memory, judge
from tests.fuzz.target import TARGETS, Target, load

#: What is watched for coverage beside servod, by the targets' module. Not PyYAML: watched, it is too slow.
LIBRARIES = {"tests.fuzz.texts": ["canopen"], "tests.fuzz.recordings": ["mcap"]}
#: What numba compiles, which it cannot when its code is changed; atheris wants each module's name.
NOT_INSTRUMENTED = [
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for package in ("kernels", "lab/simulate")
    for file in sorted((ROOT / "servod" / package).rglob("*.py"))
]
_EXAMPLES = 200


class Book:
    """Counts inputs, and keeps one input for each kind of crash."""

    def __init__(self, target: Target, folder: Path) -> None:
        self._target, self._folder = target, folder
        self.inputs, self.crashes = 0, 0
        self._next_note_s = 0.0
        (folder / "crashes").mkdir(parents=True, exist_ok=True)

    def one(self, data: bytes) -> None:
        """Judge one input."""
        (self._folder / "now.bin").write_bytes(data)  # what killed the process, if this does
        self.inputs += 1
        crash = judge(self._target, data)
        if crash is not None:
            self.crashes += 1
            self._keep(crash.key, crash.text, data)
        if time.monotonic() > self._next_note_s:
            self.note()

    def _keep(self, key: str, text: str, data: bytes) -> None:
        """The shortest input of each kind."""
        name = hashlib.sha256(key.encode()).hexdigest()[:12]
        file = self._folder / "crashes" / f"{name}.bin"
        if not file.exists() or len(data) < file.stat().st_size:
            file.write_bytes(data)
            file.with_suffix(".txt").write_text(f"{key}\n{text}", errors="backslashreplace")

    def note(self) -> None:
        """Write the figures so far."""
        self._next_note_s = time.monotonic() + 0.5
        (self._folder / "figures.json").write_text(json.dumps({"inputs": self.inputs, "crashing": self.crashes}))


def _shaped(target: Target, book: Book) -> Any:
    """A hypothesis test that hands drawn inputs to the book."""

    @settings(
        database=None,
        deadline=None,
        max_examples=_EXAMPLES,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(target.shape)
    def drawn(data: bytes) -> None:
        book.one(data[:100_000])

    return drawn


def draw_until(target: Target, book: Book, end_s: float) -> None:
    """Hypothesis alone, a new seed for each round."""
    number = 0
    for seed in target.seeds:
        book.one(seed)
    while time.monotonic() < end_s:
        number += 1
        seeded(number)(_shaped(target, book))()


def search(target: Target, book: Book, way: str, folder: Path, seconds: float) -> None:
    """Coverage-guided, by atheris; ends the process."""
    import atheris

    run: Callable[[bytes], object] = book.one if way == "bytes" else _shaped(target, book).hypothesis.fuzz_one_input
    corpus = folder / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(target.seeds if way == "bytes" else ()):
        (corpus / f"seed{number}").write_bytes(seed)
    options = [
        *(f"-max_total_time={max(int(seconds), 1)}", f"-max_len={target.longest}", "-timeout=60", "-rss_limit_mb=4096"),
        *(f"-artifact_prefix={folder}/killed-", "-print_final_stats=1", "-reload=0"),
    ]
    if way == "shaped":
        options.append("-len_control=0")  # short inputs are too few choices for most shapes
    if target.words:
        words = folder / "words.txt"
        words.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words if word))
        options.append(f"-dict={words}")
    atheris.Setup([sys.argv[0], *options, str(corpus)], run)
    atheris.Fuzz()


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{octet:02x}" for octet in word[:60])


def _loaded(name: str, way: str, folder: Path) -> Target:
    """The target, its modules watched unless hypothesis draws alone."""
    if way == "drawn":
        return load(name, folder)
    import atheris

    libraries = LIBRARIES.get(TARGETS[name].partition(":")[0], [])
    with atheris.instrument_imports(
        include=["servod", *libraries], exclude=NOT_INSTRUMENTED, enable_loader_override=False
    ):
        return load(name, folder)


def main() -> None:
    """Fuzz as the arguments say."""
    name, way, place, seconds = sys.argv[1:]
    folder, end_s = Path(place), time.monotonic() + float(seconds)
    with tempfile.TemporaryDirectory(prefix="servod-fuzz-") as own:
        target = _loaded(name, way, Path(own))
        bound_memory()
        book = Book(target, folder)
        try:
            if way == "drawn":
                draw_until(target, book, end_s)
            else:
                search(target, book, way, folder, float(seconds))
        finally:
            book.note()


if __name__ == "__main__":
    main()
