"""The guards of the drive tried on the stepped virtual axis: what stops in time, what does not, and the proof of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from servod.common.errors import AnswerIsNo, Unreachable
from servod.drivers.virtual.pdo import Rpdo
from servod.drivers.virtual.power_state import DriveCommand
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.config import AxisConfig
from servod.formats.model.axis_model import AxisModel
from servod.formats.protocol import Verb
from servod.runtime.daemon import guard_test
from servod.runtime.daemon.connection import Reply
from servod.runtime.daemon.guard_test import (
    PROOF_NAME,
    GuardResult,
    GuardTest,
    GuardTestStatus,
    _Cycles,
    _Silence,
    guard_test_status,
    keep_proof,
    read_record,
    require_guard_test,
)
from servod.runtime.daemon.verbs import Verbs
from servod.runtime.fieldbus.cia import decode_status_word
from servod.runtime.fieldbus.devices import AmplifierFeedback, DriveState, Goal
from servod.runtime.fieldbus.master import Master
from tests.axis_limits import LIMITS
from tests.on_event_loop import events_pass, on_event_loop

JOINT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.01, "viscous": 0.05}}
DAY_S = 86_400.0
SILENCES = ("commands", "heartbeat", "everything")


def world_of(plant: dict[str, Any] | None = None, **settings: Any) -> SteppedWorld:
    return SteppedWorld(VirtualAxisSettings(**settings), AxisModel.model_validate(JOINT | (plant or {})))


def axis(tmp_path: Path, days: float | None = 30.0, **sections: Any) -> AxisConfig:
    amplifier = {"guard_test_days": days} | sections.pop("amplifier", {})
    gains = {"initial": "gains.yaml", "directory": str(tmp_path / "gains")}
    return AxisConfig.model_validate({"limits": LIMITS, "gains": gains, "amplifier": amplifier} | sections)


def _status(config: AxisConfig, found: dict[str, Any], now_s: float) -> GuardTestStatus:
    return guard_test_status(config, read_record(config), found, now_s)


def tried(world: SteppedWorld, config: AxisConfig) -> tuple[list[GuardResult], dict[str, Any]]:
    return GuardTest(config, world.connect, world.clock).run()


@pytest.mark.parametrize("reaction", [1, 2, 3])
def test_each_guard_stops_the_drive_in_its_time(tmp_path: Path, reaction: int) -> None:
    world = world_of()
    results, _ = tried(world, axis(tmp_path, amplifier={"heartbeat_reaction": reaction}))
    assert {result.guard: result.passed for result in results} == dict.fromkeys(SILENCES, True)
    commands, heartbeat, everything = results
    assert 19.0 <= (commands.left_ms or 0) <= 25.0
    assert 50.0 <= (heartbeat.left_ms or 0) <= 103.0
    assert 19.0 <= (everything.left_ms or 0) <= 25.0
    limits_ms = [result.limit_ms for result in results]
    assert limits_ms == [23.0, 103.0, 23.0]  # what the stop is reckoned with, and no more
    assert world.amplifier.machine.state is DriveState.SWITCH_ON_DISABLED  # the fault that the test caused is gone
    assert world.truth().torque_nm == 0.0


class Stalls(SteppedWorld):
    """The machine stands still for 30 ms in the silence of the heartbeat, `left` times."""

    left = 1

    def stall(self, test: GuardTest) -> None:
        run = _Cycles.run

        def late(drive: _Cycles, goal: Goal, cycles: int, reset: bool = False) -> AmplifierFeedback:
            if drive.silent == "heartbeat" and self.left:
                self.left -= 1
                self.clock.sleep_until(self.clock.now_ns() + 30_000_000)
            return run(drive, goal, cycles, reset)

        _Cycles.run = late  # type: ignore[method-assign]
        try:
            self.results = test.run()[0]
        finally:
            _Cycles.run = run  # type: ignore[method-assign]


def test_a_heartbeat_that_the_command_deadline_covers_is_tried_anew(tmp_path: Path) -> None:
    world = Stalls(VirtualAxisSettings(), AxisModel.model_validate(JOINT))
    world.stall(GuardTest(axis(tmp_path), world.connect, world.clock))
    assert {result.guard: result.passed for result in world.results} == dict.fromkeys(SILENCES, True)
    assert (world.results[1].left_ms or 0) > 50.0
    world.left = 1000
    with pytest.raises(Unreachable, match="heartbeat: each time the drive told that another of its guards"):
        world.stall(GuardTest(axis(tmp_path), world.connect, world.clock))
    assert world.amplifier.machine.state.unpowered


class LooksLate(SteppedWorld):
    """The machine stands still before an answer of the drive is looked at, from 19 to 35 ms after the last command."""

    left, late_ms = 1, 16

    def late(self, test: GuardTest) -> list[GuardResult]:
        run = _Cycles.run

        def stands(drive: _Cycles, goal: Goal, cycles: int, reset: bool = False) -> AmplifierFeedback:
            feedback = run(drive, goal, cycles, reset)
            since_ns = self.clock.now_ns() - drive.last_ns["commands"]
            if drive.silent == "commands" and self.left and since_ns > 18_000_000:
                self.left -= 1
                self.clock.sleep_until(self.clock.now_ns() + self.late_ms * 1_000_000)
            return feedback

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_Cycles, "run", stands)
            return test.run()[0]


def test_a_stop_that_is_looked_at_too_late_is_tried_anew(tmp_path: Path) -> None:
    world = LooksLate(VirtualAxisSettings(), AxisModel.model_validate(JOINT))
    results = world.late(GuardTest(axis(tmp_path), world.connect, world.clock))
    assert {result.guard: result.passed for result in results} == dict.fromkeys(SILENCES, True)
    assert results[0].left_ms is not None and results[0].left_ms <= 23.0, "no bound is another one"
    world.left = 1000
    with pytest.raises(Unreachable, match=r"commands: .* was looked at too late, since this machine stood still"):
        world.late(GuardTest(axis(tmp_path), world.connect, world.clock))
    assert world.amplifier.machine.state.unpowered


@pytest.mark.parametrize("how", [KeyboardInterrupt, SystemExit, RuntimeError])
@pytest.mark.parametrize("silent", ["", *SILENCES])
@pytest.mark.parametrize("cycles_fail", [False, True])
def test_a_test_that_is_broken_off_leaves_the_drive_off(
    tmp_path: Path, how: type[BaseException], silent: str, cycles_fail: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    world, run, hit = world_of(), _Cycles.run, False

    def broken_off(drive: _Cycles, goal: Goal, cycles: int, reset: bool = False) -> AmplifierFeedback:
        nonlocal hit
        enabled = world.amplifier.machine.state is DriveState.OPERATION_ENABLED
        if drive.silent == silent and enabled and not hit:
            hit = True
            raise how
        if hit and cycles_fail:
            raise how
        return run(drive, goal, cycles, reset)

    monkeypatch.setattr(_Cycles, "run", broken_off)
    with pytest.raises(how):
        tried(world, axis(tmp_path))
    assert hit
    assert world.amplifier.machine.state.unpowered


def test_nothing_is_enabled_while_the_emergency_stop_is_active(tmp_path: Path) -> None:
    world = world_of()
    world.amplifier.dictionary.entry(0x2000, 7).value = 0
    with pytest.raises(AnswerIsNo, match="emergency stop is active"):
        tried(world, axis(tmp_path, amplifier={"inputs": {"estop_bit": 16}}))
    assert world.amplifier.machine.last_transition != 4
    world.amplifier.dictionary.entry(0x2000, 7).value = 0x30000
    assert all(result.passed for result in tried(world, axis(tmp_path, amplifier={"inputs": {"estop_bit": 16}}))[0])


def test_the_drive_is_tried_as_the_daemon_runs_it(tmp_path: Path) -> None:
    """With the ramp that the stop is reckoned with; the raw configuration leaves what stood in the drive."""
    world, written = world_of(), []
    ramp = world.amplifier.dictionary.entry(0x6085)
    hook = ramp.written
    ramp.written = lambda value: (written.append(value), hook(value) if hook else None)
    assert all(result.passed for result in tried(world, axis(tmp_path, stopping={"least_inertia": 0.001}))[0])
    assert written[0] > 33_000_000  # 0.8 of 1 N*m on 0.001 kg*m^2; it stands at 200 rad/s^2 before


@pytest.mark.parametrize("option", [5, 6, 7, 8])
def test_a_drive_that_stays_in_quick_stop_active_passes_and_is_left_off(tmp_path: Path, option: int) -> None:
    world = world_of()
    results, _ = tried(world, axis(tmp_path, amplifier={"quick_stop_option": option, "heartbeat_reaction": 3}))
    assert all(result.passed for result in results)
    assert world.amplifier.machine.state.unpowered


def test_a_drive_that_holds_for_a_brake_by_output_passes_and_is_left_off(tmp_path: Path) -> None:
    """By 0x6007 = 3 it holds in quick stop active, so that a supervisor which outlives its loop can close the brake."""
    world = world_of(brake="output")
    brake = {"by": "output", "output_bit": 16}
    results, _ = tried(world, axis(tmp_path, amplifier={"quick_stop_option": 6, "brake": brake}))
    assert all(result.passed for result in results)
    assert world.amplifier.machine.state.unpowered


def test_a_drive_that_only_tells_is_found(tmp_path: Path) -> None:
    """Its EMCY comes in time, and its torque stays: a real stop is asked for, whatever the drive says of itself."""
    world = world_of(command_deadline="tells")
    world.amplifier.dictionary.set_default(0x2007, 0, 1)
    results, _ = tried(world, axis(tmp_path))
    assert [result.passed for result in results] == [False, True, False]
    assert world.amplifier.machine.state.unpowered


@pytest.mark.parametrize(
    ("after_ms", "says"),
    [
        (20, r"leaves operation by itself \(FAULT_REACTION_ACTIVE, error 0x7305\) while nothing is silent"),
        (220, r"leaves operation by itself"),  # twice the heartbeat's time is not over yet
        (255, r"commands: the drive says that it stopped for another reason \(error 0x7305\)"),
    ],
)
def test_a_drive_that_stops_for_another_reason_proves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after_ms: int, says: str
) -> None:
    """It trips so long after each enabling, whether anything is silent or not."""
    world, run = world_of(), _Cycles.run
    enabled_ns = 0

    def tripping(drive: _Cycles, goal: Goal, cycles: int, reset: bool = False) -> AmplifierFeedback:
        nonlocal enabled_ns
        on = world.amplifier.machine.state is DriveState.OPERATION_ENABLED
        enabled_ns = (enabled_ns or world.clock.now_ns()) if on else 0
        tripped = enabled_ns and world.clock.now_ns() - enabled_ns > after_ms * 1_000_000
        world.amplifier.dictionary.entry(0x2000, 1).value = 0x7305 if tripped else 0
        return run(drive, goal, cycles, reset)

    monkeypatch.setattr(_Cycles, "run", tripping)
    with pytest.raises(AnswerIsNo, match=says):
        tried(world, axis(tmp_path))
    assert world.amplifier.machine.state.unpowered


class Acting(SteppedWorld):
    """Something happens once, so many ms into a silence, or into the rest before it (`silent` empty)."""

    def act(self, config: AxisConfig, silent: str, at_ms: float, act: Callable[[], object]) -> list[GuardResult]:
        run, begun_ns, acted = _Cycles.run, 0, False

        def cycles(drive: _Cycles, goal: Goal, count: int, reset: bool = False) -> AmplifierFeedback:
            nonlocal begun_ns, acted
            on = self.amplifier.machine.state is DriveState.OPERATION_ENABLED
            begun_ns = (begun_ns or self.clock.now_ns()) if on and drive.silent == silent else 0
            if begun_ns and not acted and self.clock.now_ns() - begun_ns >= at_ms * 1e6:
                acted = True
                act()
            return run(drive, goal, count, reset)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_Cycles, "run", cycles)
            results = GuardTest(config, self.connect, self.clock).run()[0]
        assert acted
        return results


def acting(**settings: Any) -> Acting:
    return Acting(VirtualAxisSettings(**settings), AxisModel.model_validate(JOINT))


@pytest.mark.parametrize("silent", SILENCES)
def test_a_trip_in_any_silence_proves_nothing(tmp_path: Path, silent: str) -> None:
    world = acting()
    trip = world.amplifier.dictionary.entry(0x2000, 1)
    with pytest.raises(AnswerIsNo, match=rf"{silent}: .* another reason \(error 0x7305\)"):
        world.act(axis(tmp_path), silent, 9.0, lambda: setattr(trip, "value", 0x7305))


@pytest.mark.parametrize("silent", SILENCES)
def test_a_drive_that_leaves_long_before_its_guard_s_time_proves_nothing(tmp_path: Path, silent: str) -> None:
    """Without a word why; the guard of the commands has 20 ms."""
    world = acting()

    def off() -> None:
        world.amplifier.machine.command(DriveCommand.DISABLE_VOLTAGE, world.clock.now_ns())

    with pytest.raises(AnswerIsNo, match=rf"{silent}: the drive left the command [\d.]+ ms into the silence"):
        world.act(axis(tmp_path), silent, 2.0, off)


@pytest.mark.parametrize("silent", ["", *SILENCES])
def test_an_emergency_stop_in_the_test_ends_it(tmp_path: Path, silent: str) -> None:
    world = acting()
    inputs = world.amplifier.dictionary.entry(0x2000, 7)
    config = axis(tmp_path, amplifier={"inputs": {"estop_bit": 16}})
    with pytest.raises(AnswerIsNo, match="emergency stop is active"):
        world.act(config, silent, 3.0, lambda: setattr(inputs, "value", 0))
    assert world.amplifier.machine.state.unpowered


def test_a_machine_that_stands_still_before_a_silence_begins_it_anew(tmp_path: Path) -> None:
    world = acting()
    results = world.act(axis(tmp_path), "", 60.0, lambda: world.clock.sleep_until(world.clock.now_ns() + 40_000_000))
    assert [result.passed for result in results] == [True, True, True]


def test_a_drive_without_an_error_code_is_tried_all_the_same(tmp_path: Path) -> None:
    results, _ = tried(world_of(missing_objects=["603F"]), axis(tmp_path, amplifier={"heartbeat_reaction": 1}))
    assert all(result.passed for result in results)


def test_a_proof_with_other_silences_is_told_as_such(tmp_path: Path) -> None:
    config, world = axis(tmp_path), world_of()
    results, found = tried(world, config)
    keep_proof(config, results, {key: value for key, value in found.items() if key != "silences"})
    with pytest.raises(Unreachable, match="with other silences, by an earlier version"):
        require_guard_test(_status(config, json.loads(json.dumps(found)), 1e12))


def test_a_drive_that_comes_back_in_the_silence_does_not_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world, first_ns = world_of(), list[int]()

    def told(word: int) -> DriveState:
        state = decode_status_word(word)
        if state.unpowered and not first_ns:
            first_ns.append(world.clock.now_ns())
        return DriveState.OPERATION_ENABLED if first_ns and world.clock.now_ns() > first_ns[0] + 20_000_000 else state

    monkeypatch.setattr(guard_test, "decode_status_word", told)
    silence = _Silence("commands", "commands", 20.0)
    test = GuardTest(axis(tmp_path), world.connect, world.clock)
    master = Master(test._config, world.connect(), world.clock, threaded=False)
    seen = test._try(master, master.bring_up(), silence)
    master.close()
    assert seen is not None and seen.result.left_ms is not None and not seen.result.passed


def test_a_drive_that_looks_at_its_deadline_at_sync_alone_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the commands alone away it stops in time; when this computer dies there is no SYNC either."""
    missed, applied = Rpdo._missed, Rpdo.apply
    late: dict[Rpdo, int] = {}

    def apply(rpdo: Rpdo) -> bool:
        if rpdo in late:
            late.pop(rpdo)
            missed(rpdo, world.clock.now_ns())
        return applied(rpdo)

    monkeypatch.setattr(Rpdo, "_missed", lambda rpdo, time_ns: late.update({rpdo: time_ns}))
    monkeypatch.setattr(Rpdo, "apply", apply)
    world = world_of()
    results, _ = tried(world, axis(tmp_path))
    assert {result.guard: result.passed for result in results} == dict(zip(SILENCES, (True, True, False), strict=True))
    assert 50.0 <= (results[2].left_ms or 0) <= 103.0  # by the heartbeat


def test_where_only_the_heartbeat_counts_only_it_is_tried(tmp_path: Path) -> None:
    results, _ = tried(world_of(command_deadline="none"), axis(tmp_path))
    assert [(result.guard, result.passed) for result in results] == [("heartbeat", True), ("everything", True)]
    assert results[1].limit_ms == 103.0
    with pytest.raises(AnswerIsNo, match="nothing to test"):
        tried(world_of(missing_objects=["1400:5", "6007"]), axis(tmp_path, amplifier={"unguarded": True}))


def test_a_fault_of_the_drives_own_is_not_reset(tmp_path: Path) -> None:
    world = world_of()
    world.amplifier.dictionary.entry(0x2000, 1).value = 0x7305
    world.clock.sleep_until(world.clock.now_ns() + 10_000_000)
    world.amplifier.dictionary.entry(0x2000, 1).value = 0
    with pytest.raises(Unreachable, match=r"a fault of its own \(error 0x7305\)"):
        tried(world, axis(tmp_path))
    assert world.amplifier.machine.state is DriveState.FAULT


def test_a_joint_that_moves_without_torque_ends_the_test(tmp_path: Path) -> None:
    world = world_of({"gravity": {"amplitude": 0.1, "phase": 1.57}})
    with pytest.raises(AnswerIsNo, match="moves without torque"):
        tried(world, axis(tmp_path))
    assert world.amplifier.machine.state.unpowered


def test_a_proof_holds_for_its_drive_its_guards_and_its_time(tmp_path: Path) -> None:
    config, world = axis(tmp_path), world_of()
    with pytest.raises(Unreachable, match="never tested"):
        require_guard_test(_status(config, {}, 0.0))
    results, found = tried(world, config)
    path = keep_proof(config, results, found)
    assert path.name == PROOF_NAME
    now_s = json.loads(path.read_text())["time"]
    found = json.loads(json.dumps(found))
    require_guard_test(_status(config, found, now_s + 29 * DAY_S))
    with pytest.raises(Unreachable, match=r"older than amplifier.guard_test_days \(30\)"):
        require_guard_test(_status(config, found, now_s + 31 * DAY_S))
    with pytest.raises(Unreachable, match="dated in the future"):
        require_guard_test(_status(config, found, now_s - DAY_S))
    for other in (world_of(amplifier_serial=7), world):
        changed = axis(tmp_path, amplifier={"heartbeat_reaction": 2} if other is world else {})
        with pytest.raises(Unreachable, match="are others than those that were tested"):
            require_guard_test(_status(config, json.loads(json.dumps(tried(other, changed)[1])), now_s))
    whole = path.read_text()
    endless = {**json.loads(whole), "time": 10**400}
    del endless["sha256"]
    for broken, said in (
        (json.dumps({**endless, "sha256": guard_test._sha256(endless)}), "was changed since"),
        ("{", "cannot be read .*no JSON document"),
        ("[]", "was changed since"),
        (whole.replace(str(now_s), "NaN"), "was changed since"),
        (whole.replace(str(now_s), str(now_s + DAY_S)), "was changed since"),
        (whole.replace('"guard": "commands"', '"guard": "commanded"'), "was changed since"),
    ):
        path.write_text(broken)
        with pytest.raises(Unreachable, match=said):
            require_guard_test(_status(config, found, now_s))
    require_guard_test(_status(axis(tmp_path, days=None), found, now_s))


@pytest.mark.parametrize("days", [30.0, None])
@on_event_loop
async def test_the_daemon_enables_nothing_while_a_proof_is_asked_for(tmp_path: Path, days: float | None) -> None:
    config, loop = axis(tmp_path, days), MagicMock(latest=None, proofs=(0, None))
    told = list[dict[str, Any]]()
    proof = _status(config, {}, 0.0)
    front = Verbs(config, loop, MagicMock(), MagicMock(), dict, dict, lambda bus: bus, lambda: proof)
    front.handle(Verb.ENABLE, {}, Reply(told.append, 1))
    await events_pass()
    front.close()
    assert loop.send.called is (days is None)
    assert ["never tested" in answer["error"]["message"] for answer in told] == [True] * (days is not None)
