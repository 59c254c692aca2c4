"""Loop and supervisor die at once at peak torque: what the record of the drive, which knows nothing of them, says."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.client.stepped import SteppedSession
from servod.common.faults import FAULTS, FaultCode
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.drive_record import DriveRecord, read_drive_record
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.config import AxisConfig
from servod.formats.gains.gain_set import pd_set
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.cia import SYNC_ID
from servod.runtime.fieldbus.devices import DriveState
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op, Refusal
from tests.axis_limits import LIMITS

LIGHT = {"inertia": 0.001, "friction": {"kind": "coulomb_viscous", "coulomb": 0.005, "viscous": 0.002}}


def stepping(folder: Path, reaction: int = 3, known: bool = True, **settings: object) -> SteppedSession:
    """An axis in the step of 0.14 rad, at the torque that drive and stopping distance leave of 0.3 N*m."""
    world = SteppedWorld(
        VirtualAxisSettings.model_validate(settings),
        AxisModel.model_validate(LIGHT),
        DriveRecord(folder / "drive.bin", 20_000),
    )
    limits = LIMITS | {"torque_nm": 0.3, "torque_rate_nm_per_s": 3000.0}
    document: dict[str, object] = {
        "limits": limits,
        "gains": {"initial": "gains.yaml"},
        "wiring_proof": {"enabled": False},
    }
    document["amplifier"] = {"heartbeat_reaction": reaction}
    if known:
        document["stopping"] = {"least_inertia": 0.00095, "most_inertia": 0.00105, "least_friction_nm": 0.004}
    gains = pd_set("stiff", 5.0, 0.05)
    session = SteppedSession(AxisConfig.model_validate(document), world, gains.law.number, gains.pack())
    session.enable()
    return session


@pytest.mark.parametrize(("reaction", "gone_ms"), [(2, 25), (3, 60)])  # voltage off; the drive's ramp until rest
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_drive_leaves_the_command_when_both_died_at_peak_torque(
    tmp_path: Path, direction: float, reaction: int, gone_ms: int
) -> None:
    session = stepping(tmp_path, reaction)
    begin_step(session, direction)
    reach_peak(session)
    died_ns = session.clock.now_ns()
    session.world.clock.sleep_until(died_ns + 400_000_000)
    after = [sample for sample in read_drive_record(tmp_path / "drive.bin") if sample.time_ns > died_ns]
    left_ns = next(sample.time_ns for sample in after if sample.state is not DriveState.OPERATION_ENABLED)
    gone_ns = max(sample.time_ns for sample in after if abs(sample.torque_nm) > 0.0)
    assert left_ns - died_ns <= 22_000_000
    assert gone_ns - died_ns <= gone_ms * 1_000_000
    assert after[-1].torque_nm == 0.0
    assert after[-1].state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)


@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("deadline", ["stops", "none"])
def test_torque_is_gone_in_time_when_sync_is_lost_at_peak_torque(
    tmp_path: Path, direction: float, deadline: str
) -> None:
    """The drive hears the commands, so its deadline does not pass, and obeys none of them."""
    session = stepping(tmp_path, command_deadline=deadline)
    begin_step(session, direction)
    reach_peak(session)
    session.loop_bus.inject(BusFault(FaultKind.DROP, can_id=SYNC_ID, amount=60_000))
    lost_ns = session.clock.now_ns()
    session.run(0.4)
    after = [sample for sample in read_drive_record(tmp_path / "drive.bin") if sample.time_ns > lost_ns]
    assert max(sample.time_ns for sample in after if abs(sample.torque_nm) > 0.0) - lost_ns <= 60_000_000
    assert after[-1].state in (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
    assert session.cycle.axis.latched & FAULTS[FaultCode.DRIVE_STAYS_POWERED].bit


@pytest.mark.parametrize("period_us", [1000, 4000, 20_000])
def test_an_orphaned_loop_that_cannot_hear_the_drive_ends_in_a_second(period_us: int) -> None:
    config = AxisConfig.model_validate({
        "limits": LIMITS, "gains": {"initial": "gains.yaml"}, "cycle": {"period_us": period_us}, "heartbeat": {},
    })  # fmt: skip
    settings = VirtualAxisSettings(cycle_period_s=1e-6 * period_us)
    gains = pd_set("pd", 2.5, 0.12)
    world = SteppedWorld(settings, AxisModel.model_validate(LIGHT))
    session = SteppedSession(config, world, gains.law.number, gains.pack())
    session.run(0.2)
    session.loop_bus.inject(BusFault(FaultKind.SILENT, amount=60_000, participant=1))
    session.die(loop=False, supervisor=True)
    session.run(0.9)
    assert not session.cycle.finished
    session.run(0.2)
    assert session.cycle.finished and not session.cycle.seen_off


def reach_peak(session: SteppedSession) -> None:
    """Run until the torque rises no more: what the limits leave a joint that nobody may command from now on."""
    before_nm = 0.0
    for _ in range(50):
        session.run(0.001)
        felt_nm = abs(session.world.truth().torque_nm)
        if 0.05 < felt_nm <= before_nm:
            return
        before_nm = felt_nm
    raise AssertionError("no peak")


def begin_step(session: SteppedSession, direction: float) -> None:
    """The reference jumps: the law asks for all the torque that it may."""
    session.cycle.reference.hold(session.cycle.encoder_position_rad + direction * 0.14)


def test_the_loop_knows_a_torque_limit_that_stands_tighter_in_the_drive(tmp_path: Path) -> None:
    """0x6072 of the engineer: the loop clips there itself, so the drive never has to (status word bit 11)."""
    session = stepping(tmp_path, known=False, max_torque_permille=1200)
    begin_step(session, 1.0)
    session.clear()
    session.run(0.03)
    assert max(abs(record.torque_nm) for record in session.records) == pytest.approx(0.12, abs=1e-9)
    assert not any(record.status_word & 1 << 11 for record in session.records)
    assert session.cycle.axis.state is AxisState.ENABLED
    assert session.send(Op.DISABLE) is Refusal.DONE
