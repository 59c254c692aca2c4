"""Network management of the nodes (CiA 301): boot-up, NMT, heartbeat in both directions, emergencies."""

from __future__ import annotations

import struct

import pytest

from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.runtime.fieldbus.cia import Emcy, NmtCommand, NmtState, Obj301, Obj402
from servod.runtime.fieldbus.devices import DriveState
from tests.drivers.virtual.bench import AMPLIFIER, ENCODER, MASTER, Bench, abort_code

HEARTBEAT_MS = 100


def test_boot_up_then_pre_operational_then_heartbeat(bench: Bench) -> None:
    bench.pass_time(0.01)
    assert bench.frames(0x701) == [b"\x00"]
    assert bench.frames(0x702) == [b"\x00"]
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_PRODUCER, 0, 50, 2)
    bench.pass_time(0.501)
    assert bench.frames(0x701)[1:] == [bytes((NmtState.PRE_OPERATIONAL,))] * 10


@pytest.mark.parametrize(
    ("command", "state"),
    [
        (NmtCommand.START, NmtState.OPERATIONAL),
        (NmtCommand.STOP, NmtState.STOPPED),
        (NmtCommand.PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
    ],
)
def test_nmt_commands_move_one_node_or_all(bench: Bench, command: NmtCommand, state: NmtState) -> None:
    bench.nmt(command, ENCODER)
    assert bench.world.encoder.state is state
    assert bench.world.amplifier.state is NmtState.PRE_OPERATIONAL
    bench.nmt(command)
    assert bench.world.amplifier.state is state


@pytest.mark.parametrize("command", [NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION])
def test_resets_boot_again(bench: Bench, command: NmtCommand) -> None:
    bench.write(AMPLIFIER, Obj402.MAX_TORQUE, 0, 500, 2)
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_PRODUCER, 0, 50, 2)
    bench.pass_time(0.01)
    bench.nmt(command)
    assert bench.frames(0x701) == [b"\x00", b"\x00"]
    assert bench.read(AMPLIFIER, Obj301.HEARTBEAT_PRODUCER) == 0
    assert bench.read(AMPLIFIER, Obj402.MAX_TORQUE) == (3000 if command == NmtCommand.RESET_NODE else 500)


def test_stopped_answers_neither_sdo_nor_sync(bench: Bench) -> None:
    bench.operational()
    bench.nmt(NmtCommand.STOP)
    bench.heard.clear()
    bench.cycle(0x06)
    assert bench.heard == []
    with pytest.raises(TimeoutError):
        bench.read(AMPLIFIER, 0x1000)


def watched(bench: Bench, reaction: int, behaviour: int) -> None:
    """Enabled and moving, the master's heartbeat supervised, reaction by 0x6007 and 0x1029."""
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_CONSUMER, 1, MASTER << 16 | HEARTBEAT_MS, 4)
    bench.write(AMPLIFIER, Obj402.ABORT_CONNECTION, 0, reaction, 2)
    bench.write(AMPLIFIER, Obj301.ERROR_BEHAVIOUR, 1, behaviour, 1)
    bench.spinning(2.0)
    bench.bus.send(0x700 + MASTER, b"\x05")


@pytest.mark.parametrize(
    ("reaction", "state"),
    [
        (0, DriveState.OPERATION_ENABLED),
        (1, DriveState.FAULT),
        (2, DriveState.SWITCH_ON_DISABLED),
        (3, DriveState.SWITCH_ON_DISABLED),
    ],
)
@pytest.mark.parametrize(
    ("behaviour", "nmt"), [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)]
)
def test_a_silent_master_stops_the_drive(
    bench: Bench, reaction: int, state: DriveState, behaviour: int, nmt: NmtState
) -> None:
    watched(bench, reaction, behaviour)
    bench.cycle(0x0F, 1000, cycles=HEARTBEAT_MS - 5)
    assert bench.state is DriveState.OPERATION_ENABLED
    bench.pass_time(0.2)
    assert bench.state is state
    assert bench.world.amplifier.state is nmt
    assert struct.pack("<HB", Emcy.HEARTBEAT_LOST, 0x11) in [data[:3] for data in bench.frames(0x081)]
    if reaction:
        assert bench.torque_nm == 0.0


def test_supervision_starts_with_the_first_heartbeat(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_CONSUMER, 1, MASTER << 16 | HEARTBEAT_MS, 4)
    bench.pass_time(1.0)
    assert bench.frames(0x081) == []
    bench.bus.send(0x700 + MASTER, b"\x05")
    bench.pass_time(0.2)
    assert len(bench.frames(0x081)) == 1


def test_a_master_that_boots_again_counts_as_lost_and_is_found_again(bench: Bench) -> None:
    watched(bench, 1, 1)
    bench.bus.send(0x700 + MASTER, b"\x00")
    bench.pass_time(0.1)
    assert bench.state is DriveState.FAULT
    bench.bus.send(0x700 + MASTER, b"\x05")
    bench.pass_time(0.01)
    assert bench.frames(0x081)[-1][:3] == b"\x00\x00\x00"


def test_duplicate_consumers_are_refused(bench: Bench) -> None:
    entry = MASTER << 16 | HEARTBEAT_MS
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_CONSUMER, 1, entry, 4)
    bench.write(AMPLIFIER, Obj301.HEARTBEAT_CONSUMER, 1, entry + 1, 4)
    assert abort_code(lambda: bench.write(AMPLIFIER, Obj301.HEARTBEAT_CONSUMER, 2, entry, 4)) == 0x06040043


def test_emergencies_error_register_and_history(bench: Bench) -> None:
    bench.operational()
    for code in (0x2310, 0x4210):
        bench.write(AMPLIFIER, 0x2000, 1, code, 2)
        bench.write(AMPLIFIER, 0x2000, 1, 0, 2)
        bench.cycle(0x00, cycles=2)
        assert bench.read(AMPLIFIER, Obj301.ERROR_REGISTER) == {0x2310: 0x03, 0x4210: 0x09}[code]
        bench.cycle(0x80, cycles=2)
        assert bench.read(AMPLIFIER, Obj301.ERROR_REGISTER) == 0
    assert [data[:3] for data in bench.frames(0x081)] == [b"\x10\x23\x03", b"\0\0\0", b"\x10\x42\x09", b"\0\0\0"]
    history = [bench.read(AMPLIFIER, Obj301.ERROR_HISTORY, i) for i in range(3)]
    assert history == [2, 0x4210, 0x2310]
    assert abort_code(lambda: bench.write(AMPLIFIER, Obj301.ERROR_HISTORY, 0, 1, 1)) == 0x06090030
    bench.write(AMPLIFIER, Obj301.ERROR_HISTORY, 0, 0, 1)
    assert abort_code(lambda: bench.read(AMPLIFIER, Obj301.ERROR_HISTORY, 1)) == 0x08000024


def test_emergency_inhibit_time(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj301.EMCY_INHIBIT, 0, 100, 2)  # 10 ms
    bench.write(ENCODER, Obj301.EMCY_INHIBIT, 0, 100, 2)
    bench.write(ENCODER, 0x2000, 1, 1, 2)
    bench.write(ENCODER, 0x2000, 1, 0, 2)
    bench.pass_time(0.05)
    times = [frame.time_ns for frame in bench.heard if frame.can_id == 0x082]
    assert len(times) == 2
    assert times[1] - times[0] >= 9_900_000


def test_bus_off_of_the_drive_stops_it_and_it_comes_back(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj402.ABORT_CONNECTION, 0, 2, 2)
    bench.spinning()
    bench.bus.inject(BusFault(FaultKind.BUS_OFF, participant=AMPLIFIER))
    assert (bench.state, bench.torque_nm) == (DriveState.SWITCH_ON_DISABLED, 0.0)
    bench.pass_time(0.2)
    assert struct.pack("<H", Emcy.BUS_OFF_RECOVERED) in [data[:2] for data in bench.frames(0x081)]


def test_a_silent_node_is_silent_and_returns(bench: Bench) -> None:
    bench.bus.inject(BusFault(FaultKind.SILENT, amount=50, participant=ENCODER))
    with pytest.raises(TimeoutError):
        bench.read(ENCODER, 0x1000)
    bench.pass_time(0.06)
    assert bench.read(ENCODER, 0x1000) == 0x00020196


def test_store_and_restore(bench: Bench) -> None:
    bench.write(AMPLIFIER, Obj402.MAX_TORQUE, 0, 700, 2)
    bench.write(AMPLIFIER, Obj301.STORE, 1, 0x65766173, 4)
    bench.write(AMPLIFIER, Obj402.MAX_TORQUE, 0, 800, 2)
    bench.nmt(NmtCommand.RESET_NODE)
    assert bench.read(AMPLIFIER, Obj402.MAX_TORQUE) == 700
    bench.write(AMPLIFIER, Obj301.RESTORE, 1, 0x64616F6C, 4)
    bench.nmt(NmtCommand.RESET_NODE)
    assert bench.read(AMPLIFIER, Obj402.MAX_TORQUE) == 3000
    assert bench.read(AMPLIFIER, Obj301.STORE, 1) == 1
