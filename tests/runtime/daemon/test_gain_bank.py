"""What runs and what is stored as active are the same set, also when the store cannot be written."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from servod.common.errors import AnswerIsNo, BadInput, Unreachable
from servod.common.shipped import shipped
from servod.formats.config import load_config
from servod.formats.gains.store import Action, GainStore
from servod.formats.protocol import Verb
from servod.formats.recording.record import CycleRecord
from servod.runtime.daemon.arguments import GainsActivateArgs, GainsVerdictArgs
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.gain_bank import GainBank
from servod.runtime.daemon.guard_test import GuardTestStatus
from servod.runtime.daemon.requests import LoopTimeout
from servod.runtime.daemon.verbs import Verbs
from servod.runtime.loop.commands import Op
from tests.on_event_loop import events_pass, on_event_loop
from tests.runtime.daemon.daemon_rows import axis_config, record

FIRST, TRIED = "demo_pd", "demo_pd_dob"


class Loop:
    """Takes every set at once; knows by its serial number which one runs."""

    def __init__(self) -> None:
        self.serial = 0

    async def send(self, op: Op, arguments: Sequence[float]) -> CycleRecord:
        assert op is Op.ACTIVATE
        self.serial = int(arguments[0])
        return record(1)


class Bench:
    """A bank with its store and a loop."""

    def __init__(self, folder: Path, slow: ThreadPoolExecutor) -> None:
        config = self.config = load_config(shipped("gains/config/virtual.yaml"))
        gains = config.gains.model_copy(update={"directory": folder})
        self.bank, self.loop, self.slow = GainBank(config.model_copy(update={"gains": gains})), Loop(), slow
        self.store, self.blocked = GainStore(folder), folder / f"active.json.{os.getpid()}.tmp"
        self.store.load_file(shipped(f"gains/{TRIED}.yaml"))

    @property
    def runs(self) -> str:
        return self.bank.describe(self.loop.serial)["name"]

    @property
    def active(self) -> str:
        stored = self.store.active()
        assert stored is not None
        return stored.name

    def activate(self, trial: bool) -> dict[str, Any]:
        return asyncio.run(self.bank.activate(GainsActivateArgs(name=TRIED, trial=trial), self.loop.send, self.slow))

    def keep(self) -> dict[str, Any]:
        return asyncio.run(self.bank.keep(GainsVerdictArgs(), self.loop.send, self.slow))

    def rollback(self, trial: bool) -> dict[str, Any]:
        return asyncio.run(self.bank.rollback(GainsVerdictArgs(trial=trial), self.loop.send, self.slow))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with ThreadPoolExecutor(1) as slow:
        yield Bench(tmp_path, slow)


def test_a_trial_that_cannot_be_kept_is_undone(bench: Bench) -> None:
    bench.activate(trial=True)
    assert (bench.runs, bench.active) == (TRIED, FIRST)
    bench.blocked.mkdir()  # as a disk that is full: the new active.json cannot be written
    with pytest.raises(OSError, match=r"active\.json"):
        bench.keep()
    assert (bench.runs, bench.active, bench.bank.on_trial) == (FIRST, FIRST, False)
    with pytest.raises(AnswerIsNo, match="no gain set is on trial"):
        bench.rollback(trial=True)
    bench.blocked.rmdir()
    bench.activate(trial=True)
    bench.keep()
    assert (bench.runs, bench.active, bench.bank.on_trial) == (TRIED, TRIED, False)


def test_a_set_that_cannot_be_stored_as_active_does_not_run_on(bench: Bench) -> None:
    bench.blocked.mkdir()
    with pytest.raises(OSError, match=r"active\.json"):
        bench.activate(trial=False)
    assert (bench.runs, bench.active) == (FIRST, FIRST)
    bench.blocked.rmdir()
    bench.activate(trial=False)
    bench.blocked.mkdir()
    with pytest.raises(OSError, match=r"active\.json"):
        bench.rollback(trial=False)
    assert (bench.runs, bench.active) == (TRIED, TRIED)


def test_a_history_that_takes_no_line_refuses_nothing(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    """The activation is done by then: to call it refused left the refused set running, and active."""
    history = bench.store.directory / "history.jsonl"
    history.unlink()
    history.mkdir()
    bench.activate(trial=False)
    assert (bench.runs, bench.active) == (TRIED, TRIED)
    assert "without a line on activate" in caplog.text


def test_a_file_that_goes_while_its_set_is_on_trial_is_not_needed_for_the_way_back(bench: Bench) -> None:
    bench.activate(trial=True)
    for file in ("active.json", "active.copy.json"):
        (bench.store.directory / file).write_bytes(bytes(40))
    (bench.store.directory / "sets" / FIRST / "0001.yaml").write_bytes(b"")
    with pytest.raises(BadInput, match=r"0001\.yaml"):  # it cannot be stored as active again; it runs all the same
        bench.rollback(trial=True)
    assert (bench.runs, bench.bank.on_trial) == (FIRST, False)


class SlowLoop(Loop):
    """Answers nothing while it hangs, and takes what was sent in order when it goes on."""

    def __init__(self) -> None:
        super().__init__()
        self.hangs, self.waiting = True, list[int]()

    async def send(self, op: Op, arguments: Sequence[float]) -> CycleRecord:
        if not self.hangs:
            return await super().send(op, arguments)
        self.waiting.append(int(arguments[0]))
        raise LoopTimeout("the loop did not answer in time")

    def go_on(self) -> None:
        self.hangs = False
        self.serial = self.waiting[-1]


def test_what_a_loop_takes_after_all_is_not_the_refused_set(bench: Bench) -> None:
    bench.loop = loop = SlowLoop()
    with pytest.raises(Unreachable, match="did not answer in time"):
        bench.activate(trial=False)
    loop.go_on()
    assert (bench.runs, bench.active, bench.bank.newest.name) == (FIRST, FIRST, FIRST)
    bench.activate(trial=False)
    assert (bench.runs, bench.active, bench.bank.newest.name) == (TRIED, TRIED, TRIED)


def test_a_damaged_version_does_not_hide_the_others(bench: Bench) -> None:
    (bench.store.directory / "sets" / TRIED / "0001.yaml").write_bytes(b"parameters: {")
    rows = asyncio.run(bench.bank.list(bench.loop.serial, bench.slow))["gains"]
    assert [(row["name"], row["law"], bool(row["refused"])) for row in rows] == [
        (FIRST, "pd", False),
        (TRIED, "unknown", True),
    ]


def test_a_trial_is_given_up(bench: Bench) -> None:
    bench.activate(trial=True)
    bench.rollback(trial=True)
    assert (bench.runs, bench.active, bench.bank.on_trial) == (FIRST, FIRST, False)
    assert bench.store.history()[-1].action is Action.REJECT


@pytest.mark.parametrize(("accepts", "says"), [(True, ""), (False, "no certificate")])
def test_the_list_says_what_this_axis_may_not_run(
    accepts: bool, says: str, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The configuration may have changed since the set was stored."""
    gains = bench.config.gains.model_copy(update={"accept_uncertified": accepts})
    monkeypatch.setattr(bench.bank, "_config", bench.config.model_copy(update={"gains": gains}))
    rows = asyncio.run(bench.bank.list(bench.loop.serial, bench.slow))["gains"]
    assert sorted((row["name"], row["active"]) for row in rows) == sorted([(FIRST, True), (TRIED, False)])
    assert all(says in row["refused"] and bool(row["refused"]) != accepts for row in rows)


@on_event_loop
async def test_a_set_of_other_devices_enables_nothing(tmp_path: Path) -> None:
    config, loop, bank = (
        axis_config(tmp_path / "s", tmp_path / "c"),
        MagicMock(latest=None, proofs=(0, None)),
        MagicMock(),
    )
    bank.require_own_devices.side_effect = BadInput("gain set x: devices.amplifier.serial", 4711, "1")
    told, proof = list[dict[str, Any]](), GuardTestStatus(asked_for=False, holds=True, time=None, text="")
    front = Verbs(config, loop, bank, MagicMock(), dict, dict, lambda bus: bus, lambda: proof)
    front.handle(Verb.ENABLE, {}, Reply(told.append, 1))
    await events_pass()
    front.close()
    assert not loop.send.called
    (answer,) = told
    assert answer["error"]["exit_code"] == 2 and "amplifier.serial: found 4711" in answer["error"]["message"]
