"""What counts as done, whose folder it is, and that steps are taken up where they were interrupted."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from servod.client.open import VirtualWalkAxis
from servod.common.errors import AnswerIsNo, BadInput, Unreachable
from servod.common.progress import OnProgress
from servod.lab.commission.state import State, sole_walk, write_text
from servod.lab.commission.walk import Questions, Walk, WalkOptions, run
from tests.lab.synthesize.designs import table1

AXIS = VirtualWalkAxis(table1(), seed=1)


@contextmanager
def silent(_title: str) -> Iterator[OnProgress]:
    """No progress."""
    yield lambda _what, _share: None


def walk(folder: Path, axis: VirtualWalkAxis = AXIS, **options: Any) -> Walk:
    folder.mkdir(exist_ok=True)
    return Walk(folder, axis, WalkOptions(**options), Questions(True, lambda _q: True), silent, lambda _line: None)


@dataclass(frozen=True)
class Copy:
    """Writes its source's text and its own word into its file; may be interrupted before, and counts its runs."""

    name: str
    source: str | None
    runs: list[str]
    interrupt: bool = False
    more: tuple[str, ...] = ()
    says_no: bool = False

    @property
    def title(self) -> str:
        return self.name

    def outputs(self, _walk: Walk) -> tuple[str, ...]:
        return (f"{self.name}.txt", *(f"{self.name}_{more}.txt" for more in self.more))

    def inputs(self, walk: Walk) -> dict[str, Any]:
        return {**(walk.hashes(self.source) if self.source else {}), "accuracy": walk.options.accuracy}

    def run(self, walk: Walk) -> None:
        if self.interrupt:
            raise KeyboardInterrupt
        if self.says_no:
            raise AnswerIsNo("no")
        self.runs.append(self.name)
        before = walk.path(self.source).read_text() if self.source else ""
        for name in self.outputs(walk):
            write_text(walk.path(name), f"{before}{self.name} {walk.options.accuracy}\n")


def chain(runs: list[str], interrupted: str = "") -> tuple[Copy, ...]:
    names = [None, "one", "two", "three"]
    return tuple(
        Copy(str(name), f"{before}.txt" if before else None, runs, name == interrupted)
        for before, name in itertools.pairwise(names)
    )


def test_a_walk_is_taken_up_at_the_step_that_was_interrupted(tmp_path: Path) -> None:
    runs: list[str] = []
    for name in ("one", "two", "three"):
        with pytest.raises(KeyboardInterrupt):
            run(walk(tmp_path / "cut"), chain(runs, interrupted=name))
    state = run(walk(tmp_path / "cut"), chain(runs))
    assert runs == ["one", "two", "three"]
    assert set(state.seconds) == {"one", "two", "three"}
    run(walk(tmp_path / "whole"), chain([]))
    assert (tmp_path / "cut" / "three.txt").read_text() == (tmp_path / "whole" / "three.txt").read_text()


def test_what_is_done_is_not_done_again_and_what_changed_is(tmp_path: Path) -> None:
    runs: list[str] = []
    run(walk(tmp_path), chain(runs))
    run(walk(tmp_path), chain(runs))
    assert runs == ["one", "two", "three"]
    (tmp_path / "three.txt").unlink()
    run(walk(tmp_path), chain(runs))
    assert runs[3:] == ["three"]
    run(walk(tmp_path, accuracy=0.05), chain(runs))
    assert runs[4:] == ["one", "two", "three"]


@pytest.mark.parametrize("way_out", ["delete", "again"])
def test_an_edited_file_is_named_with_the_way_out(way_out: str, tmp_path: Path) -> None:
    runs: list[str] = []
    run(walk(tmp_path), chain(runs))
    edited = tmp_path / "two.txt"
    whole = edited.read_text()
    edited.write_text("by hand\n")
    with pytest.raises(BadInput, match=r"two\.txt.*changed after the step two.*delete it or use --again two"):
        run(walk(tmp_path), chain(runs))
    assert edited.read_text() == "by hand\n" and runs == ["one", "two", "three"]
    if way_out == "delete":
        edited.unlink()
        run(walk(tmp_path), chain(runs))
    else:
        run(walk(tmp_path, again=("two",)), chain(runs))
    assert edited.read_text() == whole
    assert runs[3:] == ["two"]  # what came out is the same, so the step after it stays


def test_an_edited_file_is_kept_although_the_step_is_to_be_done_anew(tmp_path: Path) -> None:
    """By other inputs, or for another of its files that is gone."""
    runs: list[str] = []
    steps = (Copy("one", None, runs, more=("a", "b")),)
    run(walk(tmp_path), steps)
    (tmp_path / "one_a.txt").write_text("by hand\n")
    (tmp_path / "one_b.txt").unlink()
    for accuracy in (walk(tmp_path).options.accuracy, 0.05):
        with pytest.raises(BadInput, match=r"one_a\.txt.*changed after the step one.*--again one"):
            run(walk(tmp_path, accuracy=accuracy), steps)
    assert (tmp_path / "one_a.txt").read_text() == "by hand\n" and runs == ["one"]
    run(walk(tmp_path, again=("one",)), steps)
    assert runs == ["one", "one"] and (tmp_path / "one_a.txt").read_text() == (tmp_path / "one_b.txt").read_text()


def test_an_interrupted_repetition_is_no_edited_file(tmp_path: Path) -> None:
    run(walk(tmp_path), chain([]))
    with pytest.raises(KeyboardInterrupt):
        run(walk(tmp_path, again=("two",)), chain([], interrupted="two"))
    (tmp_path / "two.txt").write_text("half of it\n")
    runs: list[str] = []
    run(walk(tmp_path), chain(runs))
    assert runs == ["two"]


@pytest.mark.parametrize("way_out", ["no", "interrupt"])
def test_a_step_that_fails_leaves_nothing_of_its_earlier_answer_in_place(way_out: str, tmp_path: Path) -> None:
    runs: list[str] = []
    steps = (Copy("one", None, runs), Copy("two", "one.txt", runs))
    run(walk(tmp_path), steps[:1])
    (tmp_path / "two.txt").write_text("half of it\n")
    run(walk(tmp_path), steps)
    assert not (tmp_path / "earlier").exists()
    earlier = (tmp_path / "two.txt").read_text()
    failing = (steps[0], replace(steps[1], interrupt=way_out == "interrupt", says_no=way_out == "no"))
    with pytest.raises((KeyboardInterrupt, AnswerIsNo)):
        run(walk(tmp_path, again=("two",)), failing)
    assert not (tmp_path / "two.txt").exists() and (tmp_path / "one.txt").exists()
    assert (tmp_path / "earlier" / "two.txt").read_text() == earlier
    run(walk(tmp_path), steps)
    assert (tmp_path / "two.txt").read_text() == (tmp_path / "earlier" / "two.txt").read_text() == earlier


def test_only_a_step_can_be_done_again(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="--again: found four; allowed: one, two, three"):
        run(walk(tmp_path, again=("four",)), chain([]))


def test_the_folder_of_another_axis_is_refused(tmp_path: Path) -> None:
    run(walk(tmp_path), chain([]))
    heavier = VirtualWalkAxis(table1().model_copy(update={"inertia": 0.002}), seed=1)
    with pytest.raises(BadInput, match="plant"):
        run(walk(tmp_path, heavier), chain([]))
    coarser = VirtualWalkAxis(table1(), seed=1, encoder_counts=2**17)
    with pytest.raises(BadInput, match="encoder"):
        run(walk(tmp_path, coarser), chain([]))


def test_files_of_somebody_else_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "two.txt").write_text("mine\n")
    with pytest.raises(BadInput, match=r"two\.txt"):
        run(walk(tmp_path), chain([]))
    assert (tmp_path / "two.txt").read_text() == "mine\n"


@pytest.mark.parametrize("text", ["{", "{}", '{"axis": {}, "steps": {"one": 1}}'])
def test_a_broken_state_is_bad_input(text: str, tmp_path: Path) -> None:
    (tmp_path / "state.json").write_text(text)
    with pytest.raises(BadInput, match="state"):
        run(walk(tmp_path), chain([]))


def test_one_walk_at_a_time(tmp_path: Path) -> None:
    with sole_walk(tmp_path), pytest.raises(Unreachable, match="at work"), sole_walk(tmp_path):
        pass


def test_a_walk_that_is_refused_leaves_nothing(tmp_path: Path) -> None:
    class Refusing(Copy):
        def inputs(self, _walk: Walk) -> dict[str, Any]:
            raise BadInput("standard input", "no terminal to ask at", "--yes")

    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "one.txt").write_text("mine")
    for folder, step in ((tmp_path / "new", Refusing("one", None, [])), (foreign, Copy("one", None, []))):
        with pytest.raises(BadInput):
            run(walk(folder), (step,))
    assert not list((tmp_path / "new").iterdir())
    assert [entry.name for entry in foreign.iterdir()] == ["one.txt"]


def test_a_refusal_keeps_the_state_that_was_there(tmp_path: Path) -> None:
    """It may be of another axis, or cut short: whose it is, its engineer decides."""
    state = tmp_path / "state.json"
    for text in ('{"axis":', json.dumps({"axis": {"another": 1}, "steps": {}})):
        state.write_text(text)
        with pytest.raises(BadInput):
            run(walk(tmp_path), (Copy("one", None, []),))
        assert state.read_text() == text


def test_a_folder_that_is_gone_is_no_other_command(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such folder"), sole_walk(tmp_path / "gone"):
        pass


def test_a_kill_between_file_and_state_only_repeats_the_step(tmp_path: Path) -> None:
    runs: list[str] = []
    run(walk(tmp_path), chain(runs))
    state = json.loads((tmp_path / "state.json").read_text())
    del state["steps"]["two"]
    (tmp_path / "state.json").write_text(json.dumps(state))
    run(walk(tmp_path), chain(runs))
    assert runs[3:] == ["two"]
    assert State(tmp_path, AXIS.identity, []).seconds.keys() == {"one", "two", "three"}


def test_without_a_person_only_yes_agrees() -> None:
    asked: list[str] = []

    def put(question: str) -> bool:
        asked.append(question)
        return len(asked) == 1

    Questions(True, put).agree("move?")
    with pytest.raises(BadInput, match="--yes, which agrees to: move"):
        Questions(False, put, lambda: False).agree("move?")
    assert not Questions(False, put, lambda: False).takes("less?")
    assert asked == []
    Questions(False, put, lambda: True).agree("move?")
    with pytest.raises(AnswerIsNo, match="deploy"):
        Questions(False, put, lambda: True).agree("deploy?")
