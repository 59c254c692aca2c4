"""What the scenarios of the fault campaign (servod/qualify/faults/scenarios) cannot say of the stepped axis and its
faults.

The virtual drive's truth is the judge, not what the loop believes. Times are virtual and exact.
"""

from itertools import pairwise

import pytest

from servod.client.stepped import SteppedSession
from servod.common.faults import FAULTS, FaultCode
from servod.common.shipped import shipped
from servod.drivers.virtual.bus_faults import BusFault
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.kernels.laws import LAWS
from servod.runtime.fieldbus.bus import Frame
from servod.runtime.fieldbus.cia import NmtCommand
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, ReferenceKind, Refusal

AMPLIFIER, ENCODER = 1, 2


def session(config: AxisConfig | None = None, plant: AxisModel | None = None) -> SteppedSession:
    gains = load_gains(shipped("gains/demo_pd.yaml"))
    world = SteppedWorld(VirtualAxisSettings(), plant or load_axis_model(shipped("gains/axes/demo_joint.yaml")))
    config = config or load_config(shipped("gains/config/virtual.yaml"))
    return SteppedSession(config, world, LAWS[gains.law.name].number, gains.pack())


def moving(axis: SteppedSession) -> SteppedSession:
    """In the middle of a sine, at its fastest, with friction to overcome."""
    axis.enable()
    assert axis.send(Op.REFERENCE, [ReferenceKind.SINE, 0.2, 0.5, 60.0]) == Refusal.DONE
    axis.run(2.0)
    assert abs(axis.world.truth().torque_nm) > 0.02
    return axis


def latched(axis: SteppedSession) -> set[FaultCode]:
    return {code for code, fault in FAULTS.items() if axis.cycle.axis.latched & fault.bit}


def inject(axis: SteppedSession, fault: BusFault) -> None:
    axis.loop_bus.inject(fault)


def nmt(axis: SteppedSession, command: NmtCommand, node_id: int) -> None:
    axis.loop_bus.send(0, bytes([command, node_id]))


def limited(name: str, value: float) -> AxisConfig:
    config = load_config(shipped("gains/config/virtual.yaml"))
    return config.model_copy(update={"limits": config.limits.model_copy(update={name: value})})


@pytest.mark.parametrize("node_id", [AMPLIFIER, ENCODER])
def test_a_node_that_was_reset_needs_a_new_bring_up(node_id):
    axis = moving(session())
    nmt(axis, NmtCommand.RESET_NODE, node_id)
    axis.run(0.5)
    nmt(axis, NmtCommand.START, node_id)
    axis.run(0.5)
    assert FaultCode.DRIVE_RESET in latched(axis)
    assert axis.send(Op.ENABLE, [1]) == Refusal.NEEDS_RESTART
    assert axis.cycle.axis.state != AxisState.ENABLED


def test_last_frame_of_a_loop_that_breaks_acts_at_once():
    """It is synchronous: without a SYNC behind it the drive would keep the torque until its own guards act. It asks for
    the drive's own ramp: without torque the joint would coast."""
    axis = moving(session())
    axis.cycle.let_go()
    axis.world.clock.sleep_until(axis.world.clock.now_ns() + 2_000_000)
    assert axis.world.amplifier.machine.state is DriveState.QUICK_STOP_ACTIVE
    speed = axis.world.truth().velocity_rad_s
    axis.world.clock.sleep_until(axis.world.clock.now_ns() + 18_000_000)
    assert abs(axis.world.truth().velocity_rad_s) < 0.05 * abs(speed)


def test_limits_hold_while_the_torque_ramps_down():
    config = limited("ramp_down_s", 1.0)
    limits = config.limits.model_copy(update={"following_error_rad": 0.05, "speed_rad_s": 1.0})
    axis = session(config.model_copy(update={"limits": limits}))
    axis.enable()
    axis.send(Op.ACTIVATE, [1, LAWS["pd"].number, 3, -8.0, 0.0, 0.0])
    axis.send(Op.REFERENCE, [ReferenceKind.STEP, 0.02, 10.0])
    fastest = 0.0
    for _ in range(3000):
        axis.run(0.001)
        fastest = max(fastest, abs(axis.world.truth().velocity_rad_s))
    assert axis.cycle.axis.state == AxisState.FAULT
    assert fastest < 3.0


def test_changing_gains_while_braking_keeps_the_torque_continuous():
    axis = moving(session())
    axis.send(Op.DISABLE)
    before = axis.latest.torque_nm
    axis.send(Op.ACTIVATE, [2, LAWS["pd"].number, 3, 2.0, 0.1, 0.0])
    steps = [b.torque_nm - a.torque_nm for a, b in pairwise(axis.records[-6:])]
    assert max(map(abs, steps)) < 0.1 * abs(before)


def test_a_joint_outside_its_range_is_not_enabled():
    axis = session(limited("position_max_rad", -0.5))
    axis.run(0.1)
    assert axis.send(Op.ENABLE, [0]) == Refusal.OUTSIDE_LIMITS


def test_motions_beyond_speed_or_range_are_refused():
    axis = session()
    axis.enable()
    assert axis.send(Op.REFERENCE, [ReferenceKind.SINE, 1.0, 10.0, 1.0]) == Refusal.TOO_FAST
    assert axis.send(Op.REFERENCE, [ReferenceKind.STEP, 4.0, 1.0]) == Refusal.OUT_OF_RANGE


@pytest.mark.parametrize(("share", "refusal"), [(0.95, Refusal.DONE), (1.05, Refusal.JUMPS), (-1.05, Refusal.JUMPS)])
def test_a_jump_that_must_end_in_a_following_error_is_refused(share: float, refusal: Refusal) -> None:
    axis = session(limited("following_error_rad", 0.1))
    axis.enable()
    assert axis.send(Op.REFERENCE, [ReferenceKind.STEP, 0.1 * share, 1.0]) == refusal
    axis.run(0.01)
    assert not latched(axis)


def test_the_error_that_is_there_counts_with_the_jump() -> None:
    """Without torque the joint stays where it is: the second step of 60 mrad would put it 120 mrad away."""
    axis = session(limited("following_error_rad", 0.1))
    axis.enable()
    axis.send(Op.ACTIVATE, [1, LAWS["pd"].number, 3, 0.0, 0.0, 0.0])
    for amplitude_rad, refusal in ((0.06, Refusal.DONE), (0.06, Refusal.JUMPS), (-0.15, Refusal.DONE)):
        assert axis.send(Op.REFERENCE, [ReferenceKind.STEP, amplitude_rad, 0.05]) == refusal
        axis.run(0.1)
    assert not latched(axis)


def test_a_node_that_babbles_with_low_priority_does_not_hold_the_loop():
    axis = moving(session())
    intruder = axis.world.connect()
    for _ in range(50):
        for _ in range(4):
            intruder.send(0x7F0, bytes(8))
        axis.run(0.001)
    assert axis.cycle.axis.state == AxisState.ENABLED
    assert isinstance(intruder.receive(0.0), Frame)


@pytest.mark.parametrize(
    ("between", "wrong", "wait_s", "refusal"),
    [
        ([], 0.0, 0.0, Refusal.DONE),
        ([], 1.0, 0.0, Refusal.NOT_CONFIRMED),
        ([], 0.0, 1.1, Refusal.NOT_CONFIRMED),
        ([(Op.HALT, (0.0,))], 0.0, 0.0, Refusal.NOT_CONFIRMED),
        ([(Op.DISABLE, ())], 0.0, 0.0, Refusal.NOT_CONFIRMED),
        ([(Op.CONFIRM, (-1.0,))], 0.0, 0.0, Refusal.NOT_CONFIRMED),
    ],
)
def test_enabling_takes_a_request_and_its_confirmation_as_the_very_next_command(between, wrong, wait_s, refusal):
    axis = session()
    axis.port.send(Op.ENABLE, (0.0, 0.0))
    axis.run(0.01)
    asked_for = axis.latest.command_result
    assert asked_for < 0
    assert axis.cycle.axis.state == AxisState.DISABLED
    for op, arguments in between:
        axis.port.send(op, arguments)
    axis.run(wait_s)
    axis.port.send(Op.CONFIRM, (asked_for + wrong,))
    axis.run(0.01)
    assert axis.latest.command_result == refusal
    axis.run(2.0)
    assert axis.cycle.axis.state == (AxisState.ENABLED if refusal == Refusal.DONE else AxisState.DISABLED)
    axis.send(Op.DISABLE)
    axis.run(1.0)
    axis.port.send(Op.CONFIRM, (asked_for,))  # nor does the old one a second time
    axis.run(0.5)
    assert axis.latest.command_result == Refusal.NOT_CONFIRMED
    assert axis.cycle.axis.state == AxisState.DISABLED
