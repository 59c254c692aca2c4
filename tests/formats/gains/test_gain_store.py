"""The gain store: versions, activation, rollback, history, and being killed in the middle."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.common.files import write_atomically
from servod.formats.gains.store import Action, GainStore
from tests.formats.gains import good

STIFFER = good.PD.replace("2.5", "3.5")


@pytest.fixture
def store(tmp_path: Path) -> GainStore:
    return GainStore(tmp_path / "gains")


def test_versions_grow_and_the_same_text_again_gets_none(store: GainStore) -> None:
    assert [store.load(text, "x").version for text in (good.PD, good.PD, STIFFER, STIFFER, good.PD)] == [1, 1, 2, 2, 3]
    first = store.get("bench_pd", 1)
    assert first.path.read_text(encoding="utf-8") == first.text == f"{good.PD}seal: {first.gains.seal}\n"
    assert store.get("bench_pd").version == 3
    assert [(s.name, s.version) for s in store.stored()] == [("bench_pd", v) for v in (1, 2, 3)]


def test_nothing_is_active_before_the_first_activation(store: GainStore) -> None:
    store.load(good.PD, "x")
    assert store.active() is None


def test_activate_and_roll_back_to_the_first(store: GainStore) -> None:
    for text in (good.PD, good.LUGRE, STIFFER):
        store.load(text, "x")
    store.activate("bench_pd", 1)
    store.activate("bench_lugre")
    store.activate("bench_pd")
    assert [store.rollback().name for _ in range(2)] == ["bench_lugre", "bench_pd"]
    active = store.active()
    assert active is not None and (active.name, active.version) == ("bench_pd", 1)
    with pytest.raises(BadInput, match="gain store: rollback: found no set that was active before"):
        store.rollback()


def test_activating_the_active_set_again_leaves_rollback_where_it_was(store: GainStore) -> None:
    store.load(good.PD, "x")
    store.load(good.LUGRE, "x")
    store.activate("bench_pd")
    store.activate("bench_lugre")
    store.activate("bench_lugre")
    assert store.previous().name == "bench_pd"


def test_another_store_on_the_directory_sees_the_same(store: GainStore) -> None:
    store.load(good.PD, "x")
    store.activate("bench_pd")
    other = GainStore(store.directory)
    assert other.active() == store.active()
    assert other.history() == store.history()


def test_history_tells_what_happened(store: GainStore) -> None:
    first = store.load(good.PD, "x")
    store.load(STIFFER, "x")
    store.activate("bench_pd", 1)
    store.activate("bench_pd")
    store.rollback()
    told = [(entry.action, entry.version) for entry in store.history()]
    assert told == [
        (Action.LOAD, 1),
        (Action.LOAD, 2),
        (Action.ACTIVATE, 1),
        (Action.ACTIVATE, 2),
        (Action.ROLLBACK, 1),
    ]
    assert store.history()[-1].sha256 == first.sha256


@pytest.mark.parametrize(
    ("name", "version", "line"),
    [
        ("none", None, "gain set: found none; allowed: bench_pd"),
        ("../sets/bench_pd", None, "gain set: found ../sets/bench_pd; allowed: bench_pd"),
        ("bench_pd", 7, "gain set bench_pd: version: found 7; allowed: 1"),
    ],
)
def test_unknown_sets_are_one_line(store: GainStore, name: str, version: int | None, line: str) -> None:
    store.load(good.PD, "x")
    with pytest.raises(BadInput) as caught:
        store.activate(name, version)
    assert str(caught.value) == line


def test_a_set_is_never_known_by_two_names(store: GainStore) -> None:
    with pytest.raises(BadInput, match=r"mine\.yaml: name: found bench_pd; allowed: other"):
        store.load(good.PD, "mine.yaml", name="other")
    assert store.names() == []


def test_a_bad_set_is_not_stored(store: GainStore) -> None:
    with pytest.raises(BadInput):
        store.load(good.PD.replace("2.5", "-1"), "bad.yaml")
    assert store.names() == []
    assert store.history() == []


def test_a_stored_file_that_somebody_broke_is_named(store: GainStore) -> None:
    path = store.load(good.PD, "x").path
    path.write_text(good.PD.replace("2.5", "-1"), encoding="utf-8")
    with pytest.raises(BadInput, match=r"0001\.yaml: parameters.position_gain_nm_per_rad: found -1"):
        store.get("bench_pd")


def test_unusable_directory_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(BadInput, match=r"gain store .*: a part of this path is a file"):
        GainStore(tmp_path / "file" / "gains")


def test_leftovers_of_a_kill_are_swept_and_a_cut_history_line_is_left_out(store: GainStore) -> None:
    stored = store.load(good.PD, "x")
    store.activate("bench_pd")
    (stored.path.parent / "0002.yaml.1.tmp").write_text("half", encoding="utf-8")
    history = store.directory / "history.jsonl"
    with history.open("a", encoding="utf-8") as file:
        file.write('{"time":"2026-11-20T1')
    again = GainStore(store.directory)
    again.load(STIFFER, "x")
    assert not list(store.directory.rglob("*.tmp"))
    assert [entry.action for entry in again.history()] == [Action.LOAD, Action.ACTIVATE, Action.LOAD]
    assert again.get("bench_pd").version == 2


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "active.json"
    write_atomically(path, "old")

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(OSError, match="No space"):
        write_atomically(path, "new")
    assert path.read_text(encoding="utf-8") == "old"


CHURN = """
import sys
from pathlib import Path
from servod.formats.gains.store import GainStore
from tests.formats.gains import good
store = GainStore(Path(sys.argv[1]))
print("ready", flush=True)
k = 0
while True:
    k += 1
    stored = store.load(good.PD.replace("2.5", str(1 + k % 7 / 8)), "x")
    store.activate(stored.name, stored.version)
    if k % 3 == 0:
        store.rollback()
"""


@pytest.mark.parametrize("delay_ms", [3, 11, 24, 41, 67])
def test_kill_in_the_middle_leaves_a_store_that_works(tmp_path: Path, delay_ms: int) -> None:
    root = Path(__file__).resolve().parents[3]
    process = subprocess.Popen([sys.executable, "-c", CHURN, str(tmp_path)], cwd=root, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    time.sleep(delay_ms / 1e3)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    store = GainStore(tmp_path)
    assert not list(tmp_path.rglob("*.tmp"))
    versions = [stored.version for stored in store.stored()]  # every stored file is whole, or this raises
    assert versions == list(range(1, len(versions) + 1))
    before = store.active()
    new = store.load(STIFFER, "x")
    store.activate(new.name, new.version)
    active = store.active()
    assert active is not None and active.version == new.version
    if before is not None:
        assert store.rollback().version == before.version
    assert all(entry.name == "bench_pd" for entry in store.history())
