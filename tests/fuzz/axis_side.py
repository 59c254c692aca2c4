"""Targets on the virtual axis's side of the bus: what any participant may send to its two nodes."""

from __future__ import annotations

import struct
from pathlib import Path

from servod.common.units import NS_PER_S
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedBus, SteppedClock, SteppedWorld
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG
from servod.runtime.fieldbus.cia import (
    HEARTBEAT_BASE,
    LSS_TO_SLAVE_ID,
    NMT_ID,
    SDO_ANSWER_BASE,
    SDO_REQUEST_BASE,
    NmtCommand,
)
from tests.drivers.virtual.bench import JOINT
from tests.fuzz.frames import frames
from tests.fuzz.shapes import frame_lists
from tests.fuzz.target import Target

_IDS = (
    *(SDO_REQUEST_BASE + 1, SDO_REQUEST_BASE + 2, LSS_TO_SLAVE_ID, NMT_ID, 0x080, 0x201, 0x301, 0x401, 0x501),
    *(
        HEARTBEAT_BASE + 126,
        HEARTBEAT_BASE + 1,
        0x181 | CAN_RTR_FLAG,
        0x701 | CAN_RTR_FLAG,
        0x601 | CAN_EFF_FLAG,
        0x7FF,
    ),
)
_SDO = tuple(
    bytes.fromhex(text)
    for text in (
        *("4000100000000000", "4008100000000000", "6000000000000000", "7000000000000000", "2F6060000A000000"),
        *("2B40600006000000", "2B40600007000000", "2B4060000F000000", "2B17100032000000", "2310160132007E00"),
        *("2100200008000000", "0061626364656667", "1061626364656667", "0F00000000000000", "8000100000000005"),
        *("A400100000000000", "A00021107F000000", "A300000000000000", "A20A7F0000000000", "A100000000000000"),
        *("C600200010000000", "C420000010000000", "0161626364656667", "8161626364656667", "C100000000000000"),
        *("23001A0000000000", "2F001A0000000000", "23001A0110004160", "2F001A0001000000", "2300140101020080"),
        *("2B05200001000000", "2310100173617665", "2311100173616F6C", "2F02180100000000", "2305100080000000"),
    )
)
_LSS = (
    *(bytes.fromhex(start).ljust(8, b"\0") for start in ("0401", "0400", "1105", "11FF", "17", "4C", "5A", "5E")),
    struct.pack("<BIBBB", 0x51, 0, 0x80, 0, 0),
)
_NMT = tuple(bytes((command, node)) for command in NmtCommand for node in (0, 1))


def virtual_axis(folder: Path) -> Target:
    """Frames of every service into both nodes; afterwards they still boot, and answer."""

    def run(data: bytes) -> None:
        world = SteppedWorld(VirtualAxisSettings(), AxisModel.model_validate(JOINT))
        _play(world, data, _IDS)

    words = (*_SDO, *_LSS, *_NMT, struct.pack("<Hh", 0x0F, 500))
    seed = b"".join(bytes((0, 8)) + w for w in _SDO) + b"".join(bytes((2, 8)) + w for w in _LSS)
    seeds = (seed, bytes((3, 2, 1, 0)) + bytes((4, 0, 5, 4, 6, 0, 0, 0)) * 4)
    return Target(run, seeds, frame_lists(_IDS, words), words)


def virtual_axis_sdo(folder: Path) -> Target:
    """SDO alone, so that the transfers are searched deeply: expedited, in segments, in blocks."""

    def run(data: bytes) -> None:
        world = SteppedWorld(VirtualAxisSettings(), AxisModel.model_validate(JOINT))
        _play(world, data, _IDS[:2])

    seed = b"".join(bytes((0, 8)) + w for w in _SDO)
    return Target(run, (seed,), frame_lists(_IDS[:2], _SDO), _SDO)


def _play(world: SteppedWorld, data: bytes, ids: tuple[int, ...]) -> None:
    """Send the frames, let time pass, and see that both nodes are still there."""
    bus, clock = world.connect(), world.clock
    for can_id, payload in frames(data, ids):
        bus.send(can_id, payload)
        _listen(bus, clock, 1e-3)
    _listen(bus, clock, 3.0)  # beyond the stall time of any transfer
    for node in world.devices.nodes:
        assert -1e3 < world.truth().torque_nm < 1e3
        bus.send(NMT_ID, bytes((NmtCommand.RESET_COMMUNICATION, 0)))
        _listen(bus, clock, 0.1)
        if node.node_id > 127:  # LSS may have taken its id away, from this reset on
            continue
        bus.send(SDO_REQUEST_BASE + node.node_id, _SDO[0])
        answers = [f for f in _listen(bus, clock, 0.1) if f[0] == SDO_ANSWER_BASE + node.node_id]
        assert len(answers) == 1, f"node {node.node_id} answers no SDO any more"


def _listen(bus: SteppedBus, clock: SteppedClock, seconds: float) -> list[tuple[int, bytes]]:
    heard, end_ns = [], clock.now_ns() + int(seconds * NS_PER_S)
    while (left_ns := end_ns - clock.now_ns()) > 0:
        frame = bus.receive(left_ns / NS_PER_S)
        if frame is not None:
            heard.append((frame.can_id, frame.data))
    return heard
