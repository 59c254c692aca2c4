"""Targets on the master's side of the bus: what nodes, or who passes for one, may send to it and to the loop."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

from hypothesis import strategies as st

from servod.common.errors import ServodError
from servod.common.faults import FaultCode
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.world import SteppedWorld
from servod.formats.config import AxisConfig
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_RTR_FLAG
from servod.runtime.fieldbus.cia import EMCY_BASE, HEARTBEAT_BASE, LSS_FROM_SLAVE_ID, SDO_ANSWER_BASE, SDO_REQUEST_BASE
from servod.runtime.fieldbus.devices import AmplifierCommand, Goal, SdoAccess
from servod.runtime.fieldbus.master import Master
from servod.runtime.fieldbus.master.eds import dictionary_for
from servod.runtime.fieldbus.master.monitor import NodeWatch
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.scan import scan as scan_bus
from servod.runtime.fieldbus.master.sdo import NodeSdo
from servod.runtime.fieldbus.registry import load_driver
from tests.axis_limits import LIMITS
from tests.drivers.virtual.bench import JOINT
from tests.fuzz.frames import BentBus, ScriptBus, ScriptClock, frames
from tests.fuzz.shapes import frame_lists
from tests.fuzz.target import Target

_NODES = (1, 2)
_SDO_IDS = (*(SDO_ANSWER_BASE + node for node in _NODES), 0x583)
#: All that a master listens to, and some that it does not.
_IDS = (
    *_SDO_IDS,
    *(base + node for base in (HEARTBEAT_BASE, EMCY_BASE, 0x180, 0x280) for node in _NODES),
    *(LSS_FROM_SLAVE_ID, 0x000, 0x080, 0x601 | CAN_RTR_FLAG, 0x1FFF_FFFF | CAN_EFF_FLAG),
)
#: SDO answers: expedited, segmented with sizes true and false, segments, aborts, acknowledgements.
_ANSWERS = tuple(
    bytes.fromhex(text)
    for text in (
        *("4300100092010200", "4F00100005000000", "4100100008000000", "41001000FFFFFFFF", "4000100000000000"),
        *("0061626364656667", "1061626364656667", "0161626364656667", "0F00000000000000", "8000100000000206", "80"),
        *("6000100000000000", "2000000000000000", "3000000000000000", "4318100192010200", "43", "", "C600100008000000"),
    )
)


def _config() -> AxisConfig:
    return AxisConfig.model_validate({"limits": LIMITS, "gains": {"initial": "gains.yaml"}})


def _world() -> SteppedWorld:
    from servod.formats.model.axis_model import AxisModel

    return SteppedWorld(VirtualAxisSettings(), AxisModel.model_validate(JOINT))


def sdo_client(folder: Path) -> Target:
    """Reads and writes of all sorts, answered by a script."""
    objects = dictionary_for("cia402", None, 1).objects

    def run(data: bytes) -> None:
        clock = ScriptClock()
        bus = ScriptBus(clock, frames(data[1:], _SDO_IDS), burst=1 + data[0] % 3 if data else 1)
        sdo = NodeSdo(BusNetwork(bus, clock, threaded=False), 1, objects)
        for access in _ACCESSES:
            with contextlib.suppress(ServodError):
                access(sdo)

    seed = b"\0" + b"".join(bytes((0, len(a))) + a for a in _ANSWERS)
    shape = frame_lists(_SDO_IDS, _ANSWERS).map(lambda script: b"\0" + script)
    return Target(run, (seed,), shape, _ANSWERS)


_ACCESSES = (
    lambda sdo: sdo.read(0x1000),
    lambda sdo: sdo.read_text(0x1008),
    lambda sdo: sdo.read(0x1018, 1),
    lambda sdo: sdo.write(0x6060, 0, 10),
    lambda sdo: sdo.write(0x1017, 0, 50),
    lambda sdo: sdo.read_bytes(0x1021),
    lambda sdo: sdo.read(0x5FFF, 1),
)


def scan(folder: Path) -> Target:
    """Who answers on a bus where anybody may; with LSS."""

    def run(data: bytes) -> None:
        clock = ScriptClock()
        scan_bus(ScriptBus(clock, frames(data, _IDS)), clock)

    lss = tuple(bytes((command,)).ljust(8, b"\0") for command in (0x4F, 0x50, 0x44, 0x5A))
    seed = b"".join(bytes((_IDS.index(LSS_FROM_SLAVE_ID), 8)) + a for a in lss * 4)
    return Target(run, (seed,), frame_lists(_IDS, (*_ANSWERS, *lss)), (*_ANSWERS, *lss))


def bring_up(folder: Path) -> Target:
    """Bring-up, watch and orderly end with both real virtual nodes, over a bus that bends their frames."""
    config = _config()

    def run(data: bytes) -> None:
        world = _world()
        master = Master(config, BentBus(world.connect(), data, _IDS), world.clock, threaded=False)
        try:
            master.bring_up()
            for _ in range(20):
                world.clock.sleep_until(world.clock.now_ns() + 20_000_000)
                master.poll()
                assert all(event.text.isprintable() for event in master.events())
            _use(master.sdo(1))
            master.stand_down()
        finally:
            master.close()

    seeds = (b"\0" * 200, bytes(range(256)), b"\0" * 60 + b"\x14\x03\xff" * 20)
    shape = st.tuples(st.integers(0, 300), st.binary(max_size=60)).map(lambda drawn: b"\0" * drawn[0] + drawn[1])
    return Target(run, seeds, shape, longest=600)


def _use(sdo: SdoAccess) -> None:
    sdo.read(0x1000)
    sdo.write(0x1017, 0, 50)


def monitor(folder: Path) -> Target:
    """Heartbeats, EMCY and SDO of a node."""

    def run(data: bytes) -> None:
        clock = ScriptClock()
        network = BusNetwork(ScriptBus(clock, iter(())), clock, threaded=False)
        watch = NodeWatch(network, 1, FaultCode.DRIVE_FAULT, 50, 150)
        watch.watch(True)
        for can_id, payload in frames(
            data, (HEARTBEAT_BASE + 1, EMCY_BASE + 1, SDO_REQUEST_BASE + 1, SDO_ANSWER_BASE + 1)
        ):
            network.notify(can_id, bytearray(payload), clock.time_ns)
            clock.time_ns += 10_000_000 * len(payload)
            watch.check()
        assert all(event.text.isprintable() for event in watch.events)

    seed = bytes((0, 1, 5, 1, 8)) + bytes.fromhex("3081010000000000") + bytes((0, 1, 0))
    return Target(run, (seed,), frame_lists((0, 1, 2, 3), (b"\x05", b"\x00", b"\x7f")))


def drivers(folder: Path) -> Target:
    """PDOs and EMCY into the cycle faces of both drivers: feedback stays finite, and torque needs an enabled drive."""
    up = Master(_config(), (world := _world()).connect(), world.clock, threaded=False).bring_up()
    goals = (Goal.ENABLED, Goal.OFF, *Goal)

    def run(data: bytes) -> None:
        amplifier, encoder = load_driver("cia402").cyclic(up.amplifier), load_driver("cia406").cyclic(up.encoder)
        ids, time_ns = (*amplifier.receive_ids, *encoder.receive_ids), 0
        for number, (can_id, payload) in enumerate(frames(data, ids)):
            time_ns += payload[0] * 10_000 if payload else 0
            for device in (amplifier, encoder):
                if can_id in device.receive_ids:
                    device.on_frame(can_id, payload, time_ns)
            shown, sensed = amplifier.read(), encoder.read()
            assert all(map(math.isfinite, (shown.position_rad, shown.torque_nm)))
            assert all(map(math.isfinite, (sensed.position_rad, sensed.velocity_rad_s)))
            torque_nm = (0.5, math.nan, math.inf, -1e300)[number % 4]
            amplifier.write(AmplifierCommand(goals[number % len(goals)], torque_nm, reset_fault=number % 7 == 0))

    enabled = bytes.fromhex("3706000000000000")
    return Target(run, (bytes((0, 8)) + enabled,), frame_lists(range(5), (enabled, b"\xff" * 8, b"\x0a\0\0")))
