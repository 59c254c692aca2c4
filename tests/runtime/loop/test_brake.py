"""The holding brake by an output: never open without torque, never ENABLED while it may be closed, whatever happens."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servod.client.stepped import SteppedSession
from servod.common.errors import Unreachable
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.runtime.daemon.nodes import Nodes
from servod.runtime.fieldbus.cia import Obj402
from servod.runtime.fieldbus.devices import (
    AmplifierCommand,
    AmplifierFeedback,
    DriveInput,
    DriveState,
    Goal,
    Mode,
    Reason,
)
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.brake import BrakeTimes
from servod.runtime.loop.commands import Op, Refusal

sys.path.insert(0, str(Path(__file__).parents[2] / "conformance"))
from drivers_under_test import AmplifierBench, decode

PERIOD_S, RELEASE, ENGAGE = 1e-3, 12, 9  # times of the brake in cycles
TORQUE = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
ASKED = ("enable", "prove", "proven", "disable", "quick_stop", "reset", None)


def make_axis(by_output: bool = True) -> Axis:
    times = BrakeTimes(by_output, RELEASE * PERIOD_S, ENGAGE * PERIOD_S)
    return Axis(PERIOD_S, 0.003, 0.05, Mode.CYCLIC_SYNC_TORQUE, 0.1, sto_known=True, brake=times)


def ask(axis: Axis, what: str | None) -> None:
    if what in ("enable", "prove"):
        axis.enable(True, prove=what == "prove")
    elif what == "proven" and axis.state is AxisState.PROVING and axis.brake_open:
        axis.proven()  # by the cycle, whose test waits for the brake
    elif what == "disable":
        axis.disable()
    elif what == "quick_stop":
        axis.quick_stop()
    elif what == "reset":
        axis.reset_fault()


def feedback(state: DriveState, age: int = 0, inputs: int = 0, position_rad: float = 0.0) -> AmplifierFeedback:
    reached = state is DriveState.OPERATION_ENABLED
    return AmplifierFeedback(0, age, state, 0, 10, position_rad, 0.0, 0, reached, Reason.NONE, inputs)


def obedient(goal: Goal, holds: bool) -> DriveState:
    """A drive that is at once where it shall be."""
    stopping = DriveState.QUICK_STOP_ACTIVE if holds else DriveState.SWITCH_ON_DISABLED
    states = {Goal.ENABLED: DriveState.OPERATION_ENABLED, Goal.QUICK_STOP: stopping}
    return states.get(goal, DriveState.SWITCH_ON_DISABLED)


CYCLE = st.tuples(
    st.sampled_from(ASKED),
    st.one_of(st.just(None), st.sampled_from(DriveState)),  # the drive leaves by itself
    st.integers(0, 4),  # age of its feedback
    st.sampled_from([0, 0, 0, 0, *DriveInput]),
    st.sampled_from([0, 0, 0, 0, 0, 0, *(fault.bit for fault in FAULTS.values())]),
    st.integers(1, 25),
)


@settings(max_examples=400, deadline=None)
@given(story=st.lists(CYCLE, min_size=5, max_size=40), holds=st.booleans(), at_rest=st.booleans())
def test_never_open_without_torque_and_never_enabled_while_closed(
    story: list[tuple[Any, ...]], holds: bool, at_rest: bool
) -> None:
    axis, opened, heard, at_rad = make_axis(), 0, DriveState.UNKNOWN, 0.0
    for what, moves, age, inputs, faults, repeat in story:
        ask(axis, what)
        for number in range(repeat):
            state = moves if moves is not None and number == 0 else obedient(axis.goal, holds)
            if not (age if number == 0 else 0):
                heard = state
            at_rad += 0.01 if not at_rest else 0.0
            seen = feedback(heard, age if number == 0 else 0, inputs, at_rad)
            axis.step(seen, True, faults if number == 0 else 0, True)
            if axis.release_brake:
                assert heard in TORQUE, f"open in {axis.state.name} with a drive in {heard.name}"
                assert axis.goal in (Goal.ENABLED, Goal.QUICK_STOP)
            if axis.state is AxisState.ENABLED:
                assert opened > RELEASE, f"enabled {opened} cycles after the release"
            opened = opened + 1 if axis.release_brake else 0


def powered(axis: Axis) -> Axis:
    axis.enable(False)
    for _ in range(RELEASE + 6):
        axis.step(feedback(DriveState.OPERATION_ENABLED), True, 0, True)
    assert axis.state is AxisState.ENABLED
    return axis


def path(axis: Axis, cycles: int, faults: int = 0, holds: bool = True) -> list[tuple[str, bool, str]]:
    """(state, brake open, goal) wherever one of them changes."""
    seen: list[tuple[str, bool, str]] = []
    for _ in range(cycles):
        axis.step(feedback(obedient(axis.goal, holds)), True, faults, True)
        now = (axis.state.name, axis.release_brake, axis.goal.name)
        if not seen or seen[-1] != now:
            seen.append(now)
    return seen


def test_torque_first_then_the_brake_and_enabled_after_its_time() -> None:
    axis = make_axis()
    assert axis.enable(False) == Refusal.DONE
    states = [axis.step(feedback(DriveState.OPERATION_ENABLED), True, 0, True) for _ in range(RELEASE + 6)]
    assert states[0].controlled and states[0].just_enabled, "the law holds from the first cycle on"
    assert sum(state.just_enabled for state in states) == 1
    axis = make_axis()
    axis.enable(False)
    assert path(axis, RELEASE + 6) == [
        ("RELEASING", False, "ENABLED"),
        ("RELEASING", True, "ENABLED"),
        ("ENABLED", True, "ENABLED"),
    ]


def test_disable_holds_until_the_brake_is_closed() -> None:
    axis = powered(make_axis())
    axis.disable()
    assert path(axis, 40) == [
        ("ENGAGING", False, "ENABLED"),
        ("RAMPING", False, "ENABLED"),
        ("DISABLED", False, "OFF"),
    ]


def test_a_joint_that_moves_on_is_stopped_by_the_drive_before_the_brake_closes() -> None:
    """A brake that holds is no brake that stops: the law did not bring the joint to rest in its time."""
    axis = powered(make_axis())
    axis.disable()
    for _ in range(5):
        axis.step(feedback(DriveState.OPERATION_ENABLED), True, 0, False, moving=True)
    assert axis.state is AxisState.QUICK_STOPPING
    for number in range(40):
        axis.step(feedback(DriveState.QUICK_STOP_ACTIVE, position_rad=0.01 * number), True, 0, False, moving=True)
        assert axis.release_brake
    cycles = path(axis, 60)
    assert [open_ for _, open_, _ in cycles] == [True, False, False] and cycles[-1][0] == "DISABLED"


@pytest.mark.parametrize(("unheard", "stays_open"), [(4, True), (5, False)])
def test_frames_lost_in_a_stop_close_the_brake_when_the_drive_counts_as_lost(unheard: int, stays_open: bool) -> None:
    axis = powered(make_axis())
    axis.quick_stop()
    for number in range(30):
        age = max(0, min(number - 9, unheard)) if number < 10 + unheard else 0
        axis.step(feedback(DriveState.QUICK_STOP_ACTIVE, age, position_rad=0.01 * number), True, 0, False, moving=True)
    assert axis.release_brake is stays_open


@pytest.mark.parametrize("code", [FaultCode.FOLLOWING_ERROR, FaultCode.SPEED_LIMIT, FaultCode.ESTOP_ACTIVE])
def test_stops_by_the_drive_hold_until_the_brake_is_closed(code: FaultCode) -> None:
    axis = powered(make_axis())
    bit = FAULTS[code].bit
    assert path(axis, 1, bit) == [("QUICK_STOPPING", True, "QUICK_STOP")]
    assert path(axis, 60) == [
        ("QUICK_STOPPING", True, "QUICK_STOP"),
        ("QUICK_STOPPING", False, "QUICK_STOP"),
        ("FAULT", False, "OFF"),
    ]


@pytest.mark.parametrize("code", [FaultCode.ENCODER_ALARM, FaultCode.ENCODER_IMPLAUSIBLE, FaultCode.NOT_FINITE])
@pytest.mark.parametrize("by_output", [True, False])
def test_what_spoils_the_law_alone_leaves_the_drive_to_hold(code: FaultCode, by_output: bool) -> None:
    axis = powered(make_axis(by_output))
    assert path(axis, ENGAGE, FAULTS[code].bit) == [("QUICK_STOPPING", False, "QUICK_STOP")]
    assert path(axis, 60)[-1] == ("FAULT", False, "OFF")


@pytest.mark.parametrize("by_output", [True, False])
def test_a_lost_encoder_leaves_the_drive_to_hold_until_the_brake_is_closed(by_output: bool) -> None:
    axis = powered(make_axis(by_output))
    assert path(axis, 3, FAULTS[FaultCode.FEEDBACK_STALE].bit)[-1][0] == "QUICK_STOPPING"
    lost = FAULTS[FaultCode.NODE_HEARTBEAT_LOST].bit
    cycles = [path(axis, 1, lost)[0] for _ in range(60)]
    closed = sum(state == "QUICK_STOPPING" and not open_ for state, open_, _ in cycles)
    assert closed >= ENGAGE, "the drive holds until it is closed"
    assert cycles[-1] == ("FAULT", False, "OFF")


@pytest.mark.parametrize("code", [FaultCode.DRIVE_RESET, FaultCode.STO_ACTIVE])
def test_where_the_drive_gives_no_torque_it_is_off_at_once(code: FaultCode) -> None:
    assert path(powered(make_axis()), 5, FAULTS[code].bit) == [("FAULT", False, "OFF")]


def test_a_stop_while_it_closes_does_not_open_it_again() -> None:
    axis = powered(make_axis())
    axis.disable()
    path(axis, 3)
    assert axis.state is AxisState.ENGAGING
    axis.quick_stop()
    assert [brake for _, brake, _ in path(axis, 40)] == [False, False]


def test_a_drive_that_lets_go_at_rest_is_off_when_it_does() -> None:
    axis = powered(make_axis())
    axis.quick_stop()
    assert path(axis, 5, holds=False)[-1] == ("DISABLED", False, "OFF")


# --- On the wire -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engages", ["low", "high"])
@pytest.mark.parametrize("state", list(DriveState))
@pytest.mark.parametrize("goal", list(Goal))
@pytest.mark.parametrize("wanted", [True, False])
def test_the_driver_opens_it_only_where_the_drive_gives_torque(
    engages: str, state: DriveState, goal: Goal, wanted: bool
) -> None:
    bench = AmplifierBench("cia402", brake={"by": "output", "output_bit": 5, "output_engages": engages})
    bench.say(state)
    _, data = bench.driver.write(AmplifierCommand(goal, 0.1, release_brake=wanted))
    outputs = decode(bench.command_pdo, data, Obj402.DIGITAL_OUTPUTS)
    opens = wanted and state in TORQUE and goal in (Goal.ENABLED, Goal.QUICK_STOP)
    assert outputs == (32 if opens == (engages == "low") else 0)


def braked(**changes: Any) -> tuple[AxisConfig, SteppedWorld]:
    config = load_config(shipped("gains/config/virtual.yaml"))
    brake = {"by": "output", "output_bit": 16} | changes
    data = config.model_dump(mode="json", exclude_none=True) | {"wiring_proof": {"enabled": True}}
    data["amplifier"] |= {"brake": brake, "quick_stop_option": 6}
    world = SteppedWorld(VirtualAxisSettings(brake="output"), load_axis_model(shipped("gains/axes/demo_joint.yaml")))
    return AxisConfig.model_validate(data), world


def start(config: AxisConfig, world: SteppedWorld) -> SteppedSession:
    gains = load_gains(shipped("gains/demo_pd.yaml"))
    return SteppedSession(config, world, gains.law.number, gains.pack())


def test_a_lost_loop_leaves_the_brake_closed() -> None:
    config, world = braked()
    session = start(config, world)
    session.enable()
    outputs = world.amplifier.dictionary.entry(0x60FE, 1)
    assert outputs.value == 1 << 16
    Nodes(session.master, session.bring_up).switch_off()
    assert outputs.value == 0
    assert world.amplifier.machine.state is DriveState.SWITCH_ON_DISABLED
    world.clock.sleep_until(world.clock.now_ns() + 100_000_000)
    world.truth()
    assert world.devices.joint.brake_closed


def test_a_lost_loop_is_braked_to_rest_before_the_torque_goes() -> None:
    config, world = braked()
    session = start(config, world)
    session.enable()
    joint, machine = world.devices.joint, world.amplifier.machine
    nodes = Nodes(session.master, session.bring_up)
    began_ns = world.clock.now_ns()
    nodes.brake_to_rest(2.0)
    assert 0.1 <= (world.clock.now_ns() - began_ns) / 1e9 < 0.5, "at rest, and the brake had its time"
    world.truth()
    assert machine.state is DriveState.QUICK_STOP_ACTIVE, "the drive holds until the brake is closed"
    assert joint.brake_closed
    nodes.switch_off()
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_the_wiring_is_tested_with_the_brake_open() -> None:
    config, world = braked()
    session = start(config, world)
    session.enable()
    assert session.proof is not None and session.proof.passed
    session.send(Op.DISABLE)
    session.run(0.5)
    assert world.devices.joint.brake_closed


# --- Without the loop ------------------------------------------------------------------------------------------------


class _Forgetful:
    """SDO access whose first answers of one kind are lost."""

    def __init__(self, sdo: Any, lost: str) -> None:
        self._sdo, self._lost = sdo, lost

    def __getattr__(self, name: str) -> Any:
        if name == self._lost:
            self._lost = ""
            raise Unreachable("no answer")
        return getattr(self._sdo, name)


def brake_with(monkeypatch: pytest.MonkeyPatch, sdo: Callable[[Any], Any]) -> tuple[DriveState, bool]:
    """State of the drive and whether the brake is closed, when a lost loop's axis was braked to rest."""
    config, world = braked()
    session = start(config, world)
    session.enable()
    found = sdo(session.master.sdo(session.bring_up.amplifier.node_id))
    monkeypatch.setattr(session.master, "sdo", lambda _node: found)
    Nodes(session.master, session.bring_up).brake_to_rest(2.0)
    world.truth()
    return world.amplifier.machine.state, world.devices.joint.brake_closed


@pytest.mark.parametrize("lost", ["read", "write"])
def test_a_lost_answer_does_not_keep_the_brake_open(monkeypatch: pytest.MonkeyPatch, lost: str) -> None:
    _, closed = brake_with(monkeypatch, lambda sdo: _Forgetful(sdo, lost))
    assert closed


def test_a_drive_of_unknown_state_may_have_torque_and_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("servod.runtime.daemon.nodes.decode_status_word", lambda _word: DriveState.UNKNOWN)
    assert brake_with(monkeypatch, lambda sdo: sdo) == (DriveState.QUICK_STOP_ACTIVE, True)


def test_a_drive_that_goes_on_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    config, world = braked()
    session = start(config, world)
    session.enable()
    monkeypatch.setattr("servod.runtime.daemon.nodes.decode_status_word", lambda _word: DriveState.OPERATION_ENABLED)
    positions = iter(range(1_000_000, 10**9, 10_000))
    sdo = session.master.sdo(session.bring_up.amplifier.node_id)
    monkeypatch.setattr(
        sdo, "read", lambda *_object: (world.clock.sleep_until(world.clock.now_ns() + 10**6), next(positions))[1]
    )
    began_ns = world.clock.now_ns()
    Nodes(session.master, session.bring_up).brake_to_rest(2.0)
    assert (world.clock.now_ns() - began_ns) / 1e9 < 0.2


def test_a_dead_loop_of_a_stepped_axis_is_braked_to_rest_as_by_the_daemon() -> None:
    config, world = braked()
    session = start(config, world)
    session.enable()
    began_ns = world.clock.now_ns()
    session.die(loop=True, supervisor=False)
    session.run(0.03)
    assert (world.clock.now_ns() - began_ns) / 1e9 > 0.1, "the brake had its time"
    assert world.amplifier.machine.state is DriveState.SWITCH_ON_DISABLED
    world.truth()
    assert world.devices.joint.brake_closed
