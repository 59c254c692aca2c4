"""Master and drivers on the real virtual nodes: the way to torque and back, and every way in which it can go wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from rig import Rig, stepped_world

from servod.common.errors import BadInput, Unreachable
from servod.common.faults import FaultCode
from servod.common.units import NS_PER_S
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.world import SteppedBus
from servod.runtime.fieldbus.cia import NmtCommand, Obj301, Obj402, Obj406
from servod.runtime.fieldbus.devices import DriveState, Goal, Reason, SdoAbort
from servod.runtime.fieldbus.master.sdo import SDO_TIMEOUT_S
from tests.axis_limits import LIMITS

S = DriveState


@pytest.fixture
def rig() -> Rig:
    instance = Rig()
    instance.start()
    return instance


@pytest.fixture
def enabled(rig: Rig) -> Rig:
    rig.until(Goal.ENABLED)
    return rig


@pytest.fixture
def holding() -> Rig:
    """A drive that stays in quick stop active when its master goes: 0x605A is 6."""
    instance = Rig(amplifier={"quick_stop_option": 6})
    instance.start()
    instance.until(Goal.ENABLED)
    return instance


def test_feedback_is_of_this_cycle_from_the_first_sync_on(rig: Rig) -> None:
    rig.cycle(Goal.OFF)
    for _ in range(20):
        amplifier, encoder = rig.cycle(Goal.OFF)
        assert (amplifier.age_cycles, encoder.age_cycles) == (0, 0)
        assert amplifier.state is S.SWITCH_ON_DISABLED


def test_enabling_passes_the_states_in_order_and_shows_the_mode(rig: Rig) -> None:
    states = []
    for _ in range(150):
        feedback, _ = rig.cycle(Goal.ENABLED)
        if feedback.state not in states[-1:]:
            states.append(feedback.state)
    assert states[-4:] == [S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED]
    assert feedback.goal_reached
    assert feedback.mode == 10


def test_torque_reaches_the_joint_in_newtonmetres_with_its_sign(enabled: Rig) -> None:
    amplifier, encoder = enabled.run(300, Goal.ENABLED, torque_nm=0.03)
    truth = enabled.world.truth()
    assert amplifier.torque_nm == pytest.approx(0.03, abs=2e-4)
    assert truth.torque_nm == pytest.approx(0.03, abs=2e-4)
    assert truth.velocity_rad_s == pytest.approx((0.03 - 0.01) / 0.05, rel=0.02)
    assert encoder.velocity_rad_s == pytest.approx(truth.velocity_rad_s, rel=0.01)
    assert encoder.position_rad == pytest.approx(truth.position_rad, abs=2e-3)
    assert amplifier.position_rad == pytest.approx(encoder.position_rad, abs=1e-3)


def test_torque_and_both_positions_agree_through_a_gear() -> None:
    world = stepped_world(gear_ratio=10.0)
    rig = Rig(world, amplifier={"gear_ratio": 10.0})
    rig.start()
    rig.until(Goal.ENABLED)
    amplifier, encoder = rig.run(200, Goal.ENABLED, torque_nm=0.3)
    assert amplifier.torque_nm == pytest.approx(0.3, abs=2e-3)
    assert world.truth().torque_nm == pytest.approx(0.3, abs=2e-3)
    assert encoder.position_rad > 1e-3
    assert amplifier.position_rad == pytest.approx(encoder.position_rad, abs=2e-3)


@pytest.mark.parametrize("start_rad", [-0.5, 0.0, 3.0])
def test_encoder_wraps_at_a_range_that_is_no_power_of_two(start_rad: float) -> None:
    world = stepped_world(encoder_measuring_range_counts=1_200_000, start_position_rad=start_rad)
    rig = Rig(world, limits=LIMITS | {"position_max_rad": 30.0})  # the drive itself stops at its own (0x607D)
    rig.start()
    rig.until(Goal.ENABLED)
    first = rig.run(1, Goal.ENABLED, 0.1)[1].position_rad
    true_first = world.truth().position_rad
    for _ in range(4000):
        _, encoder = rig.cycle(Goal.ENABLED, 0.1)
    assert world.truth().position_rad - true_first > 2 * math.pi
    assert encoder.position_rad - first == pytest.approx(world.truth().position_rad - true_first, abs=5e-3)


def test_quick_stop_goes_through_the_drives_own_ramp(enabled: Rig) -> None:
    enabled.run(100, Goal.ENABLED, 0.05)
    feedback = enabled.until(Goal.QUICK_STOP, limit=2000)
    assert feedback.state is S.SWITCH_ON_DISABLED
    assert abs(enabled.world.truth().velocity_rad_s) < 0.05


def test_quick_stop_that_holds_is_left_by_transition_16(holding: Rig) -> None:
    assert holding.until(Goal.QUICK_STOP).state is S.QUICK_STOP_ACTIVE
    assert holding.until(Goal.ENABLED).state is S.OPERATION_ENABLED


def test_off_and_ready_are_reached_from_enabled(enabled: Rig) -> None:
    assert enabled.until(Goal.READY).state is S.READY_TO_SWITCH_ON
    enabled.until(Goal.ENABLED)
    assert enabled.until(Goal.OFF).state is S.SWITCH_ON_DISABLED


def inject_drive_fault(rig: Rig, code: int) -> None:
    rig.world.amplifier.dictionary.entry(0x2000, 1).value = code


def test_a_drive_fault_needs_an_explicit_reset(enabled: Rig) -> None:
    inject_drive_fault(enabled, 0x7305)
    enabled.run(20, Goal.ENABLED)
    feedback, _ = enabled.run(200, Goal.ENABLED)
    assert feedback.state is S.FAULT
    assert feedback.reasons == Reason.IN_FAULT
    assert feedback.error_code == 0x7305
    assert FaultCode.DRIVE_FAULT in {event.fault for event in enabled.events}
    inject_drive_fault(enabled, 0)
    assert enabled.run(50, Goal.ENABLED)[0].state is S.FAULT
    enabled.cycle(Goal.ENABLED, reset_fault=True)
    assert enabled.until(Goal.ENABLED).state is S.OPERATION_ENABLED


def test_a_reset_while_the_cause_is_there_leaves_the_fault(enabled: Rig) -> None:
    inject_drive_fault(enabled, 0x7305)
    enabled.run(20, Goal.ENABLED)
    enabled.cycle(Goal.ENABLED, reset_fault=True)
    assert enabled.run(50, Goal.ENABLED)[0].state is S.FAULT


@pytest.mark.parametrize(("subindex", "value", "reason"), [(3, 0, Reason.NO_VOLTAGE), (4, 1, Reason.REMOTE_OFF)])
def test_what_keeps_the_drive_from_enabling_is_named(rig: Rig, subindex: int, value: int, reason: Reason) -> None:
    rig.world.amplifier.dictionary.entry(0x2000, subindex).value = value
    feedback, _ = rig.run(300, Goal.ENABLED)
    assert not feedback.goal_reached
    assert feedback.reasons & reason


def test_the_drive_stops_by_itself_when_the_masters_heartbeat_ends(enabled: Rig) -> None:
    enabled.run(200, Goal.ENABLED, 0.03)
    enabled.heartbeat = False
    enabled.run(250, Goal.ENABLED, 0.03)
    truth = enabled.world.truth()
    assert truth.torque_nm == 0.0
    emcy = [event.code for event in enabled.events if event.node_id == 1]
    assert 0x8130 in emcy


def test_a_reset_of_the_drive_while_operational_is_seen(enabled: Rig) -> None:
    enabled.bus.send(0, bytes((NmtCommand.RESET_NODE, 1)))
    enabled.run(100, Goal.ENABLED)
    assert FaultCode.DRIVE_RESET in {event.fault for event in enabled.events}
    assert enabled.cycle(Goal.ENABLED)[0].reasons == Reason.NO_FEEDBACK


@pytest.mark.parametrize("node_id", [1, 2])
def test_a_node_that_falls_silent_is_lost(enabled: Rig, node_id: int) -> None:
    enabled.bus.inject(BusFault(FaultKind.SILENT, amount=400, participant=node_id))
    enabled.run(300, Goal.OFF)
    assert [event.node_id for event in enabled.events if event.fault is FaultCode.NODE_HEARTBEAT_LOST] == [node_id]


def test_a_lost_feedback_frame_ages_and_comes_back(enabled: Rig) -> None:
    enabled.bus.inject(BusFault(FaultKind.DROP, can_id=0x181, amount=2))
    ages = [enabled.cycle(Goal.ENABLED)[0].age_cycles for _ in range(4)]
    assert ages == [1, 2, 0, 0]


def test_a_lost_command_frame_does_not_lose_the_reset_edge(enabled: Rig) -> None:
    inject_drive_fault(enabled, 0x7305)
    enabled.run(20, Goal.ENABLED)
    inject_drive_fault(enabled, 0)
    enabled.run(3, Goal.ENABLED)
    enabled.bus.inject(BusFault(FaultKind.DROP, can_id=0x201, amount=1))
    enabled.cycle(Goal.ENABLED, reset_fault=True)
    assert enabled.until(Goal.ENABLED).state is S.OPERATION_ENABLED


def lose_sdo_answers(rig: Rig) -> None:
    rig.bus.inject(BusFault(FaultKind.DROP, can_id=0x581, amount=1))


def test_an_sdo_time_out_costs_virtual_time_only_and_the_next_transfer_works() -> None:
    rig = Rig()
    lose_sdo_answers(rig)
    before_ns = rig.clock.now_ns()
    with pytest.raises(Unreachable, match=r"node 1 object 0x1000:0: read failed"):
        rig.master.bring_up()
    assert SDO_TIMEOUT_S <= (rig.clock.now_ns() - before_ns) / NS_PER_S < SDO_TIMEOUT_S + 0.2
    rig.start()
    rig.until(Goal.ENABLED)


def test_a_transfer_in_the_middle_is_aborted_so_the_server_is_free(rig: Rig) -> None:
    sdo = rig.master.sdo(1)
    lose_sdo_answers(rig)
    with pytest.raises(Unreachable):
        sdo.read_text(0x1008)  # type: ignore[attr-defined]
    assert sdo.read(0x1000) & 0xFFFF == 402


def powered_refusal(rig: Rig) -> None:
    rig.master.bring_up()


def mapping_refusal(rig: Rig) -> None:
    rig.master.sdo(1).write(0x1600, 1, 0x60410010)


def read_only_refusal(rig: Rig) -> None:
    rig.master.sdo(1).write(Obj402.STATUS_WORD, 0, 0)


@pytest.mark.parametrize(
    ("act", "error", "message"),
    [
        (powered_refusal, Unreachable, "is powered"),
        (mapping_refusal, SdoAbort, "0x1600:1: write refused"),
        (read_only_refusal, SdoAbort, "0x06010002 the object is read-only"),
    ],
)
def test_what_the_enabled_drive_refuses_is_said(
    holding: Rig, act: Callable[[Rig], None], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        act(holding)


def acting(spy: SteppedBus) -> list[tuple[int, bytes]]:
    """What was sent since the last look that is no SDO read: NMT commands and SDO writes."""
    heard = list(iter(lambda: spy.receive(0.0), None))
    sent = [(frame.can_id, frame.data) for frame in heard if frame.can_id in (0, 0x601, 0x602)]
    return [(can_id, data) for can_id, data in sent if can_id == 0 or data[0] != 0x40]


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({}, r"amplifier node 1 is powered \(OPERATION_ENABLED\)"),
        ({"quirks": "elmo"}, r"amplifier node 1 is powered \(OPERATION_ENABLED\)"),  # would reset its communication
        ({"identity": {"serial": 77}}, r"node 1 is another device: serial"),
    ],
)
def test_a_drive_that_somebody_runs_is_asked_and_left_alone(
    enabled: Rig, section: dict[str, Any], message: str
) -> None:
    enabled.run(50, Goal.ENABLED, 0.03)
    again, spy = Rig(enabled.world, amplifier=section), enabled.world.connect()
    with pytest.raises(Unreachable, match=message):
        again.start()
    assert acting(spy) == []
    enabled.deadline_ns = enabled.clock.now_ns()
    assert enabled.run(200, Goal.ENABLED, 0.03)[0].state is S.OPERATION_ENABLED
    assert enabled.world.truth().torque_nm == pytest.approx(0.03, abs=2e-4)
    assert enabled.master.sdo(1).read(Obj301.HEARTBEAT_CONSUMER, 1) == 126 << 16 | 100


def test_a_drive_whose_master_died_is_taken_over_when_it_has_stopped_itself(enabled: Rig) -> None:
    enabled.run(50, Goal.ENABLED, 0.03)
    enabled.clock.sleep_until(enabled.clock.now_ns() + 500_000_000)
    again = Rig(enabled.world)
    again.start()
    assert again.run(3, Goal.OFF)[0].state in (S.SWITCH_ON_DISABLED, S.FAULT)


@pytest.mark.parametrize("node_id", [1, 2])
def test_a_stopped_node_is_named_and_nothing_is_sent(rig: Rig, node_id: int) -> None:
    rig.bus.send(0, bytes((NmtCommand.STOP, node_id)))
    rig.clock.sleep_until(rig.clock.now_ns() + 1_000_000)
    again, spy = Rig(rig.world), rig.world.connect()
    with pytest.raises(Unreachable, match=f"node {node_id} is NMT stopped"):
        again.start()
    assert 0 not in [can_id for can_id, _ in acting(spy)]


def test_an_encoder_with_alarms_is_refused_before_anything_is_sent() -> None:
    world = stepped_world()
    world.encoder.dictionary.entry(Obj406.ALARMS).value = 1
    rig, spy = Rig(world), world.connect()
    with pytest.raises(Unreachable, match=r"encoder node 2 shows alarms \(0x6503 = 0x0001\)"):
        rig.start()
    assert acting(spy) == []


def test_bring_up_again_after_the_master_died(enabled: Rig) -> None:
    """The heartbeat ends, the drive stops itself; a new master finds it unpowered and enables after a reset."""
    enabled.heartbeat = False
    enabled.run(300, Goal.ENABLED)
    again = Rig(enabled.world)
    again.start()
    again.run(5, Goal.OFF)
    again.cycle(Goal.ENABLED, reset_fault=True)
    assert again.until(Goal.ENABLED).state is S.OPERATION_ENABLED


def test_an_orderly_end_leaves_no_fault_behind(enabled: Rig) -> None:
    enabled.until(Goal.OFF)
    enabled.master.stand_down()
    enabled.clock.sleep_until(enabled.clock.now_ns() + 1_000_000_000)
    again = Rig(enabled.world)
    again.start()
    assert again.until(Goal.ENABLED).error_code == 0


@pytest.mark.parametrize("encoder", [{}, {"direction": -1}, {"zero_offset_rad": 1.0}])
def test_a_preset_sets_what_the_joint_reads(encoder: dict[str, Any]) -> None:
    world = stepped_world(start_position_rad=0.3)
    Rig(world, encoder=encoder).master.preset_encoder(-0.25)
    rig = Rig(world, encoder=encoder)
    rig.start()
    _, feedback = rig.run(2, Goal.OFF)
    assert feedback.position_rad == pytest.approx(-0.25, abs=1e-5)


@pytest.mark.parametrize("position_rad", [math.nan, math.inf, -1e300, 1e5])
def test_a_preset_that_the_encoder_cannot_read_is_refused_and_nothing_is_written(position_rad: float) -> None:
    rig = Rig(stepped_world(start_position_rad=0.3))
    with pytest.raises(BadInput, match="half of what the encoder measures"):
        rig.master.preset_encoder(position_rad)
    assert rig.master.preset_encoder(0.25)[1] == pytest.approx(0.25, abs=1e-5)


def test_no_preset_while_the_drive_has_power(enabled: Rig) -> None:
    again, spy = Rig(enabled.world), enabled.world.connect()
    with pytest.raises(Unreachable, match="is powered"):
        again.master.preset_encoder(0.0)
    assert acting(spy) == []
