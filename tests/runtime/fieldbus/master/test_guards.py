"""What the drive does by itself when the master is gone: deadline of the commands, heartbeat, on the virtual nodes."""

from __future__ import annotations

from typing import Any

import pytest
from rig import Rig, stepped_world

from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.drivers.quirks import CommandDeadline, load_quirks
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.dictionary import SdoRefusal
from servod.runtime.fieldbus.cia import Emcy, NmtState, Obj301, Obj402
from servod.runtime.fieldbus.devices import DriveState, Goal
from servod.runtime.fieldbus.master.planned import reaction_s

NS_PER_MS = 1_000_000
ENERGISED = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.FAULT_REACTION_ACTIVE)


def at_torque(rig: Rig | None = None) -> Rig:
    """Enabled, moving, at 0.03 N*m."""
    rig = rig or Rig()
    rig.start()
    rig.until(Goal.ENABLED)
    rig.run(30, Goal.ENABLED, 0.03)
    assert rig.world.truth().torque_nm == pytest.approx(0.03, abs=2e-4)
    return rig


def silence(rig: Rig) -> tuple[float, float]:
    """The master sends nothing any more: ms until the drive leaves the command, and until its torque is gone."""
    begin_ns, left_ms = rig.clock.now_ns(), None
    machine = rig.world.amplifier.machine
    for ms in range(1, 500):
        rig.clock.sleep_until(begin_ns + ms * NS_PER_MS)
        if left_ms is None and machine.state is not DriveState.OPERATION_ENABLED:
            left_ms = ms
        if left_ms is not None and machine.state not in ENERGISED:
            assert rig.world.truth().torque_nm == 0.0
            return left_ms, ms
    raise AssertionError("the drive goes on without a master")


def fact(rig: Rig, name: str) -> int:
    return int(rig.up.amplifier.facts[name])


def test_a_drive_with_a_deadline_stops_20_ms_after_the_last_command() -> None:
    rig = at_torque()
    assert rig.master.sdo(1).read(Obj301.RPDO_PARAMETER, 5) == 20 == fact(rig, "reaction_ms")
    rig.run(3, Goal.ENABLED, 0.03)
    left_ms, gone_ms = silence(rig)
    assert left_ms <= 21
    assert gone_ms <= 60
    assert rig.world.amplifier.state is NmtState.PRE_OPERATIONAL  # 0x1029: a master that comes back commands nothing


@pytest.mark.parametrize(("option", "state"), [(1, DriveState.FAULT), (2, DriveState.SWITCH_ON_DISABLED)])
def test_what_it_does_at_its_deadline_is_0x6007(option: int, state: DriveState) -> None:
    rig = at_torque(Rig(amplifier={"heartbeat_reaction": option}))
    assert silence(rig)[0] <= 21
    assert rig.world.amplifier.machine.state is state


@pytest.mark.parametrize(
    ("settings", "sections"),
    [
        ({"command_deadline": "none"}, {}),
        ({"missing_objects": ["1400:5"]}, {}),
        ({}, {"heartbeat": {"command_deadline_ms": 0}}),
    ],
)
def test_where_the_heartbeat_guards_alone_two_of_its_periods_must_do(
    settings: dict[str, Any], sections: dict[str, Any]
) -> None:
    rig = at_torque(Rig(stepped_world(**settings), **sections))
    assert fact(rig, "reaction_ms") == 100
    assert rig.master.sdo(1).read(Obj301.HEARTBEAT_CONSUMER, 1) == 126 << 16 | 100
    assert 50 <= silence(rig)[0] <= 100


@pytest.mark.parametrize("settings", [{"command_deadline": "tells"}, {"missing_objects": ["2007"]}])
def test_only_a_drive_that_shows_that_it_stops_at_its_deadline_is_believed(settings: dict[str, Any]) -> None:
    """Its row is of servod's own drive, which may be set up to tell and no more: then the heartbeat counts."""
    rig = Rig(stepped_world(**settings))
    rig.start()
    assert (fact(rig, "reaction_ms"), fact(rig, "command_deadline_ms"), fact(rig, "deadline_told_ms")) == (100, 0, 20)
    assert reaction_s(rig.config, rig.up.amplifier) == 0.1
    assert any("0x2007 does not show" in line for line in rig.up.report)
    believed = Rig()
    believed.start()
    assert fact(believed, "reaction_ms") == 20


def test_a_drive_that_only_tells_of_its_deadline_goes_on_until_the_heartbeat() -> None:
    """Which is written as two periods of the master's, whatever the deadline is believed to do."""
    rig = at_torque(Rig(stepped_world(command_deadline="tells")))
    assert rig.master.sdo(1).read(Obj301.HEARTBEAT_CONSUMER, 1) == 126 << 16 | 100
    assert 50 <= silence(rig)[0] <= 100


@pytest.mark.parametrize("quirks", ["none", "epos4", "canopennode"])
def test_a_drive_of_which_nobody_has_shown_that_it_stops_at_its_deadline_only_tells(quirks: str) -> None:
    """CiA 301 asks for the EMCY alone: the heartbeat is what the stop is reckoned with; the deadline is written."""
    assert load_quirks(quirks).command_deadline is CommandDeadline.TELLS
    if quirks == "epos4":  # it counts its torque in another unit
        return
    rig = at_torque(Rig(amplifier={"quirks": quirks}))
    assert (fact(rig, "reaction_ms"), fact(rig, "command_deadline_ms"), fact(rig, "deadline_told_ms")) == (100, 0, 20)
    assert (Obj301.RPDO_PARAMETER, 5, 20) in rig.up.amplifier.facts["guards"]
    assert reaction_s(rig.config, rig.up.amplifier) == 0.1 == reaction_s(rig.config)


def test_sync_that_is_lost_may_take_longer_than_the_deadline() -> None:
    """The loop must have had no answer for limits.stale_cycles, then for the handshake, too."""
    base = Rig().config
    for stale_cycles, reaction in ((5, 0.02), (40, 0.044)):
        limits = base.limits.model_copy(update={"stale_cycles": stale_cycles})
        assert reaction_s(base.model_copy(update={"limits": limits})) == pytest.approx(reaction)


def test_commands_alone_that_do_not_arrive_stop_the_drive() -> None:
    """The heartbeat goes on, so only the deadline of the RPDO (0x1400:5) can tell."""
    rig = at_torque()
    rig.bus.inject(BusFault(FaultKind.DROP, can_id=0x201, amount=400))
    rig.run(19, Goal.ENABLED, 0.03)
    assert rig.events == []
    rig.run(40, Goal.ENABLED, 0.03)
    assert rig.world.truth().torque_nm == 0.0
    assert (rig.events[0].node_id, rig.events[0].fault, rig.events[0].code) == (
        1,
        FaultCode.DRIVE_FAULT,
        Emcy.RPDO_TIME_OUT,
    )


def test_a_deadline_that_is_taken_away_ends_at_once() -> None:
    """Written to 0 from elsewhere: the drive then holds its torque until the heartbeat is missed."""
    rig = at_torque()
    rig.world.amplifier.dictionary.download(0x1400, 5, b"\0\0")
    assert silence(rig)[0] > 50


def test_a_drive_at_rest_tells_of_its_deadline_and_stays_operational() -> None:
    rig = Rig()
    rig.start()
    rig.run(5, Goal.OFF)
    rig.clock.sleep_until(rig.clock.now_ns() + 40 * NS_PER_MS)
    amplifier = rig.world.amplifier
    assert amplifier.emergency.present(Emcy.RPDO_TIME_OUT)
    assert amplifier.state is NmtState.OPERATIONAL
    rig.deadline_ns = rig.clock.now_ns()
    rig.run(2, Goal.OFF)
    assert not amplifier.emergency.present(Emcy.RPDO_TIME_OUT)


@pytest.mark.parametrize(
    ("limits", "cycle", "heartbeat", "wanted_ms"),
    [
        ({}, {}, {}, 20),
        ({"late_cycles": 50}, {}, {}, 50),
        ({"late_cycles": 500}, {}, {}, 150),
        ({"late_cycles": 1}, {}, {}, 5),
        ({"late_cycles": 1}, {"period_us": 5000}, {}, 10),
        ({}, {"period_us": 500, "feedback_timeout_us": 300}, {}, 10),
        ({}, {}, {"command_deadline_ms": 30}, 30),
    ],
)
def test_the_deadline_follows_from_how_late_the_loop_may_be(
    limits: dict[str, Any], cycle: dict[str, Any], heartbeat: dict[str, Any], wanted_ms: int
) -> None:
    base = Rig().config
    config = type(base).model_validate(
        base.model_dump() | {"limits": base.limits.model_dump() | limits, "cycle": cycle, "heartbeat": heartbeat}
    )
    assert config.command_deadline_ms == wanted_ms


def test_objects_that_a_drive_lacks_are_absent_for_its_clients() -> None:
    dictionary = stepped_world(missing_objects=["6007", "1400:5"]).amplifier.dictionary
    for index, subindex, code in ((Obj402.ABORT_CONNECTION, 0, 0x06020000), (0x1400, 5, 0x06090011)):
        with pytest.raises(SdoRefusal) as refused:
            dictionary.upload(index, subindex)
        assert refused.value.code == code


# --- Guards that are read again ---


def test_a_drive_without_any_guard_is_refused_unless_that_is_wanted() -> None:
    missing = {"missing_objects": ["1400:5", "6007"]}
    with pytest.raises(Unreachable, match="does not stop by itself when servod is dead"):
        Rig(stepped_world(**missing)).start()
    rig = Rig(stepped_world(**missing), amplifier={"unguarded": True})
    rig.start()
    assert rig.up.amplifier.facts["unguarded"] is True
    rig = Rig(stepped_world(missing_objects=["6007"]))  # its deadline is left
    rig.start()
    assert rig.up.amplifier.facts["unguarded"] is False


def test_guards_are_read_again_and_a_change_is_a_fault() -> None:
    """Written past the bus to something else while the axis runs; without a change there is no event."""
    rig = Rig()
    rig.start()
    guards = rig.up.amplifier.facts["guards"]
    names = {f"{index:04X}:{subindex}" for index, subindex, _ in guards}
    wanted = "6072:0 60E0:0 60E1:0 6080:0 607F:0 607D:1 607D:2 6065:0 6066:0 605A:0 605E:0 6007:0 1016:1 1029:1 1400:5"
    assert names == set(wanted.split()) | {"2007:0"}
    rig.run(4500, Goal.OFF)
    assert rig.events == []
    for index, subindex, value in [guard for guard in guards if guard[0] in (0x6007, 0x1016, 0x607D)]:
        rig.world.amplifier.dictionary.entry(index, subindex).value = value + 1
        rig.run(4500, Goal.OFF)
        (event,) = rig.events
        assert event.fault is FaultCode.GUARD_CHANGED
        assert event.text == f"node 1: 0x{index:04X}:{subindex} was {value}, now reads {value + 1}"
        rig.world.amplifier.dictionary.entry(index, subindex).value = value
        rig.events.clear()


def test_a_drive_that_no_longer_stops_at_its_deadline_is_noticed() -> None:
    """The stop is reckoned with a deadline that the drive showed (0x2007) at the start: what shows it is a guard. Where
    the drive never showed it, or the deadline is not used, the heartbeat counts, and there is nothing to guard."""
    rig = Rig()
    rig.start()
    assert fact(rig, "reaction_ms") == 20
    rig.world.amplifier.dictionary.entry(0x2007, 0).value = 0
    rig.run(4500, Goal.OFF)
    (event,) = rig.events
    assert (event.fault, event.text) == (FaultCode.GUARD_CHANGED, "node 1: 0x2007:0 was 1, now reads 0")
    for other in (Rig(stepped_world(command_deadline="tells")), Rig(heartbeat={"command_deadline_ms": 0})):
        other.start()
        assert 0x2007 not in {index for index, _, _ in other.up.amplifier.facts["guards"]}


def test_a_drive_that_was_reset_is_told_of_once_and_not_of_each_guard_that_it_lost() -> None:
    rig = Rig()
    rig.start()
    rig.world.devices.power_on(rig.clock.now_ns())
    rig.run(6000, Goal.OFF)
    assert FaultCode.DRIVE_RESET in {event.fault for event in rig.events}
    assert FaultCode.GUARD_CHANGED not in {event.fault for event in rig.events}


def test_guards_are_asked_a_few_times_a_second_and_disturb_no_transfer() -> None:
    rig = Rig()
    rig.start()
    spy, sdo = rig.world.connect((0x601,)), rig.master.sdo(1)
    for _ in range(100):
        rig.run(20, Goal.OFF)
        assert sdo.read(0x1000) & 0xFFFF == 402
        rig.deadline_ns = rig.clock.now_ns()
    asked = [frame for frame in iter(lambda: spy.receive(0.0), None) if frame.data[1:3] != b"\x00\x10"]
    assert 6 <= len(asked) <= 9  # in two seconds
    assert rig.events == []


def test_a_drive_that_answers_no_more_is_told_once() -> None:
    rig = Rig()
    rig.start()
    rig.bus.inject(BusFault(FaultKind.DROP, can_id=0x581, amount=100))
    rig.run(6000, Goal.OFF)
    assert [event.text for event in rig.events] == ["node 1: the guards of the drive cannot be read any more"]


def test_an_orderly_end_gives_the_drive_its_own_limits_back() -> None:
    rig = Rig()
    before = {index: rig.world.amplifier.dictionary.value(index) for index in (0x6072, 0x60E0, 0x6080, 0x6065)}
    rig.start()
    entry = rig.world.amplifier.dictionary.value
    assert all(entry(index) != value for index, value in before.items() if index in (0x6080, 0x6065))
    rig.run(5, Goal.OFF)
    rig.master.stand_down()
    assert {index: entry(index) for index in before} == before


# --- The master before us ---


def test_what_the_drive_tells_of_a_dead_master_is_no_fault_of_the_next() -> None:
    """The drive's guard fires in the middle of the next bring-up: its EMCY comes then."""
    rig = Rig()
    rig.start()
    rig.run(5, Goal.OFF)
    again = Rig(rig.world)
    consumer = rig.world.amplifier.consumer
    again.master.sdo(2).read(0x1000)
    rig.clock.sleep_until(rig.clock.now_ns() + 160 * NS_PER_MS)
    assert consumer is rig.world.amplifier.consumer
    assert rig.world.amplifier.emergency.present(Emcy.HEARTBEAT_LOST)
    again.start()
    again.run(200, Goal.OFF)
    assert again.events == []
    assert not rig.world.amplifier.emergency.present(Emcy.HEARTBEAT_LOST)
    assert any("errors so far, newest first: 0x8130" in line for line in again.up.report)


def test_a_second_loss_of_the_master_is_told_again() -> None:
    rig = Rig()
    for _ in range(2):
        rig = Rig(rig.world)
        rig.start()
        rig.run(60, Goal.OFF)
        spy = rig.world.connect((0x81,))
        rig.clock.sleep_until(rig.clock.now_ns() + 200 * NS_PER_MS)
        codes = [frame.data[:2] for frame in iter(lambda: spy.receive(0.0), None)]  # noqa: B023
        assert b"\x30\x81" in codes


def test_an_error_that_no_fault_state_shows_is_refused() -> None:
    rig = Rig()
    rig.world.amplifier.dictionary.entry(0x1001).value = 0x09
    with pytest.raises(Unreachable, match="0x1001 = 0x09"):
        rig.start()
