"""Damaged files of the gain store: no set runs with other numbers than were stored, and every start begins."""

from __future__ import annotations

import hashlib
import logging
import os
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.common.files import MOST_BYTES, write_atomically
from servod.common.shipped import shipped
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import parse_gains
from servod.formats.gains.store import Action, GainStore, sealed_text
from servod.runtime.daemon.gain_bank import GainBank
from tests.formats.gains import good

STIFFER = good.PD.replace("2.5", "3.5")


@pytest.fixture
def config(tmp_path: Path) -> AxisConfig:
    """The shipped virtual axis with a store of its own, at work for a while; the last set of each kind is active."""
    config = load_config(shipped("gains/config/virtual.yaml"))
    gains = config.gains.model_copy(update={"directory": tmp_path / "gains", "accept_uncertified": True})
    return config.model_copy(update={"gains": gains})


def _used(config: AxisConfig, active: str) -> GainBank:
    bank = GainBank(config)
    store = GainStore(config.gains.directory)
    for text in (good.PD, STIFFER, good.LUGRE, good.certified(parse_gains(good.LOCAL, "x")).to_yaml(), active):
        stored = store.load(text, "x")
        store.activate(stored.name, stored.version)
    bank = GainBank(config)
    assert bank.newest == store.active() and bank.describe(0)["note"] == ""
    return bank


def _damaged(content: bytes, drawn: random.Random) -> bytes:
    """One bit flipped, the end cut off, or a stretch of zeros, as disks do it."""
    at = drawn.randrange(len(content))
    match drawn.randrange(5):
        case 0:
            return content[:at]
        case 1:
            end = min(len(content), at + drawn.choice((1, 16, 512)))
            return content[:at] + bytes(end - at) + content[end:]
        case _:
            return content[:at] + bytes([content[at] ^ 1 << drawn.randrange(8)]) + content[at + 1 :]


def _stored_files(folder: Path) -> Iterator[Path]:
    yield from sorted(folder.glob("active*.json"))
    yield from sorted((folder / "sets").rglob("*.yaml"))


LONG = [pytest.mark.long, pytest.mark.timeout(900)]
CERTIFIED = good.certified(parse_gains(good.PD.replace("bench_pd", "certified"), "x")).to_yaml()


@pytest.mark.parametrize(
    ("rounds", "active"),
    [
        pytest.param(60, good.PD, id="a set that came without a seal"),
        pytest.param(60, CERTIFIED, id="a certified set"),
        pytest.param(2500, good.PD, id="long, without a seal", marks=LONG),
        pytest.param(2500, CERTIFIED, id="long, certified", marks=LONG),
    ],
)
def test_no_damage_runs_other_numbers_or_ends_a_start(
    rounds: int, active: str, config: AxisConfig, caplog: pytest.LogCaptureFixture
) -> None:
    """Two thirds of the damage is to what decides: the active set's file, and the one that names it."""
    caplog.set_level(logging.CRITICAL, "servod")
    folder, drawn = config.gains.directory, random.Random(rounds)
    before = _used(config, active).newest
    packed = {(one.name, one.version): one.gains.pack() for one in GainStore(folder).stored()}
    initial = parse_gains(config.gains.initial.read_text(), "x")
    whole = folder.with_name("whole")
    shutil.copytree(folder, whole)
    told = 0
    for _ in range(rounds):
        files = list(_stored_files(folder))
        path = drawn.choice([before.path, folder / "active.json"]) if drawn.random() < 2 / 3 else drawn.choice(files)
        content = path.read_bytes()
        path.write_bytes(_damaged(content, drawn))
        bank = GainBank(config)
        runs, note = bank.newest, bank.describe(0)["note"]
        if (runs.name, runs.version) == (before.name, before.version):
            assert runs.gains.pack() == before.gains.pack()
        else:
            assert note and runs.gains.pack() == initial.pack()
            told += 1
        for name, version in GainStore(folder).versions():  # whatever else is readable has its numbers, too
            if (name, version) in packed:
                try:
                    assert GainStore(folder).get(name, version).gains.pack() == packed[name, version]
                except BadInput:
                    continue
        shutil.rmtree(folder)
        shutil.copytree(whole, folder)
    assert told > rounds / 5


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.long)])  # 7: each bit of a byte in turn
def test_every_single_bit_of_a_set_that_came_without_a_seal(step: int, config: AxisConfig) -> None:
    """36 of 1,276 such flips ran in silence once, a velocity gain of 8.12 in place of 0.12 among them."""
    store = GainStore(config.gains.directory)
    stored = store.load(good.PD, "x")
    content, refused = stored.path.read_bytes(), 0
    for bit in range(0, 8 * len(content), step):
        bent = bytearray(content)
        bent[bit // 8] ^= 1 << bit % 8
        stored.path.write_bytes(bent)
        try:
            assert store.get("bench_pd").gains == stored.gains
        except BadInput as error:
            assert str(stored.path) in str(error)
            refused += 1
    assert refused > 0.9 * 8 * len(content) / step  # the rest are blanks, quotes and comments


def test_a_damaged_active_file_gives_way_to_its_copy_aloud(
    config: AxisConfig, caplog: pytest.LogCaptureFixture
) -> None:
    before = _used(config, good.PD).newest
    file = config.gains.directory / "active.json"
    for content in (b"", bytes(40), b'{"current": 1}', file.read_bytes().replace(b'"bench_pd"', b'"bench_pe"', 1)):
        file.write_bytes(content)
        bank = GainBank(config)
        assert bank.newest == before
        assert "active.json" in bank.describe(0)["note"] and "was taken in its place" in caplog.text
        assert GainBank(config).describe(0)["note"] == ""  # mended
    file.unlink()
    assert "no file, although it has a copy" in GainBank(config).describe(0)["note"]


def test_without_either_the_initial_set_runs_and_says_what_to_do(
    config: AxisConfig, caplog: pytest.LogCaptureFixture
) -> None:
    _used(config, good.PD)
    for name in ("active.json", "active.copy.json"):
        (config.gains.directory / name).write_bytes(b"{")
    bank = GainBank(config)
    assert bank.newest.gains.name == parse_gains(config.gains.initial.read_text(), "x").name
    assert "(gains.initial) runs in place of the set that was active" in bank.describe(0)["note"]
    assert "`servoctl gains activate` the one that is meant" in caplog.text
    assert GainBank(config).describe(0)["note"] == ""  # it is the active one from then on


def test_a_start_that_fails_leaves_the_active_set_as_it_was(config: AxisConfig) -> None:
    """Nothing but `begin` says which set is active, be the present one unfit or its copy gone."""
    stored = _used(config, good.PD).newest
    stored.path.write_text(good.PD.replace("2.5", "2.6"))
    (config.gains.directory / "active.copy.json").unlink()

    def kept() -> dict[str, bytes]:
        return {file.name: file.read_bytes() for file in config.gains.directory.glob("*.json*")}

    before = kept()
    bank = GainBank(config, begins=False)
    assert "runs in place of bench_pd" in bank.describe(0)["note"] and kept() == before
    assert "gains load" not in bank.describe(0)["note"], "it would refuse this file, too"
    bank.begin()
    assert GainStore(config.gains.directory).active() == bank.newest


def test_a_store_of_an_earlier_version_goes_on(config: AxisConfig) -> None:
    """It had sets without a seal, of which the history has the hash, and an active.json without one."""
    _used(config, good.PD)
    folder = config.gains.directory
    stored = GainStore(folder).get("bench_pd")
    write_atomically(stored.path, good.PD)
    history = (folder / "history.jsonl").read_text()
    old = GainStore(folder)
    with pytest.raises(BadInput, match="no seal, and no hash of it in the history"):
        old.get("bench_pd")
    write_atomically(
        folder / "history.jsonl", history.replace(stored.sha256, hashlib.sha256(good.PD.encode()).hexdigest())
    )
    (folder / "active.copy.json").unlink()
    state = (folder / "active.json").read_text()
    write_atomically(
        folder / "active.json",
        "\n".join(line for line in state.splitlines() if "sha256" not in line).replace("],", "]"),
    )
    bank = GainBank(config)
    assert (bank.newest.name, bank.newest.version, bank.newest.gains.seal) == ("bench_pd", stored.version, None)
    assert bank.describe(0)["note"] == "" and "sha256" in (folder / "active.json").read_text()
    stored.path.write_text(good.PD.replace("2.5", "2.6"))
    assert "runs in place of bench_pd" in GainBank(config).describe(0)["note"]
    again = GainStore(folder).load(good.PD, "x")  # the explicit way: it is stored once more, with a seal
    assert again.version == stored.version + 1 and not again.gains.seal_broken and again.gains.seal


@pytest.mark.parametrize("text", [good.PD, "---\n" + good.PD + "...\n", good.PD + "\n# the end", good.LUGRE])
def test_a_seal_comes_to_any_text_and_changes_no_number(text: str) -> None:
    gains = parse_gains(text, "x")
    sealed = sealed_text(text, gains)
    assert parse_gains(sealed, "x") == gains.sealed()
    assert sealed_text(sealed, gains.sealed()) == sealed
    in_braces = '{"schema_version": 1, "name": "a", "parameters": ' + gains.parameters.model_dump_json()
    in_braces += ', "provenance": {"author": "A", "date": "2026-11-20"}}'
    braced = parse_gains(in_braces, "x")
    assert parse_gains(sealed_text(in_braces, braced), "x") == braced.sealed()


def test_the_oldest_versions_go_but_no_active_one_nor_those_before(tmp_path: Path) -> None:
    store = GainStore(tmp_path, max_versions=3)
    for n in range(8):
        stored = store.load(good.PD.replace("2.5", f"2.{n}"), "x")
        if n in (1, 2):
            store.activate(stored.name, stored.version)
    assert [version for _, version in store.versions()] == [2, 3, 6, 7, 8]
    assert store.rollback().version == 2


def test_a_long_history_forgets_its_oldest_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servod.formats.gains.store._KEPT_LINES", 10)
    store = GainStore(tmp_path)
    store.load(good.PD, "x")
    for _ in range(30):
        store.activate("bench_pd")
    again = GainStore(tmp_path)
    assert [entry.action for entry in again.history()] == [Action.ACTIVATE] * 10
    assert again.get("bench_pd") == store.get("bench_pd")


@pytest.mark.parametrize("kind", ["folder", "pipe"])
@pytest.mark.parametrize("name", ["history.jsonl", "active.copy.json", "x.1.tmp", "lock", "sets/bench_pd/0001.yaml"])
def test_no_file_where_one_should_be_ends_no_start_but_for_the_lock_which_it_names(
    tmp_path: Path, name: str, kind: str
) -> None:
    store = GainStore(tmp_path)
    store.load(good.PD, "x")
    store.activate("bench_pd")
    (tmp_path / name).unlink(missing_ok=True)
    if kind == "folder":
        (tmp_path / name / "below").mkdir(parents=True)
    else:
        os.mkfifo(tmp_path / name)
    if name == "lock":
        with pytest.raises(BadInput, match=f"^gain store {tmp_path}/lock: .*(a folder|a pipe)"):
            GainStore(tmp_path)
        return
    again = GainStore(tmp_path)
    assert again.load(good.PD, "x").version == (2 if "sets" in name else 1)
    again.load(good.LUGRE, "x")
    again.activate("bench_lugre")
    active = GainStore(tmp_path).active()
    assert active is not None and active.name == "bench_lugre"


def test_a_copy_that_a_full_disk_left_behind_never_brings_an_older_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither one that could not be written, nor one that a power cut left as it was."""
    store = GainStore(tmp_path)
    for text in (good.PD, good.LUGRE):
        store.load(text, "x")
    store.activate("bench_pd")
    copy = tmp_path / "active.copy.json"
    older = copy.read_text()

    def full(path: Path, text: str) -> None:
        if path == copy:
            raise OSError(28, "No space left on device")
        write_atomically(path, text)

    with monkeypatch.context() as patch:
        patch.setattr("servod.formats.gains.store.write_atomically", full)
        store.activate("bench_lugre")
    assert not copy.exists()
    copy.write_text(older)
    GainStore(tmp_path)
    (tmp_path / "active.json").write_text("{")
    active = GainStore(tmp_path).active()
    assert active is not None and active.name == "bench_lugre"


def test_a_damaged_copy_is_mended_and_the_log_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = GainStore(tmp_path)
    store.load(good.PD, "x")
    store.activate("bench_pd")
    copy = tmp_path / "active.copy.json"
    whole = copy.read_text()
    GainStore(tmp_path)
    assert caplog.text == ""
    copy.write_text(whole.replace("bench", "trench"))
    GainStore(tmp_path)
    assert copy.read_text() == whole
    assert "active.copy.json: is not what active.json says; written again from it" in caplog.text


def test_with_both_files_damaged_the_refusal_names_both(tmp_path: Path) -> None:
    for name in ("active.json", "active.copy.json"):
        (tmp_path / name).write_text("{")
    with pytest.raises(BadInput, match=r"active.json: found no JSON document .* in its copy active.copy.json no JSON"):
        GainStore(tmp_path).active()


def test_a_history_that_is_a_folder_is_told_of_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "history.jsonl").mkdir()
    GainStore(tmp_path)
    assert "history.jsonl: is no file; move it away" in caplog.text


def test_of_a_history_beyond_what_is_read_the_newest_stays(tmp_path: Path) -> None:
    store = GainStore(tmp_path)
    store.load(good.PD, "x")
    path = tmp_path / "history.jsonl"
    line = path.read_bytes()
    path.write_bytes(b"\n" * MOST_BYTES + line)
    again = GainStore(tmp_path)
    assert [entry.name for entry in again.history()] == ["bench_pd"]
    assert path.stat().st_size < MOST_BYTES
