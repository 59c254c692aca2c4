"""A bench for the stepped virtual axis: plain SDO, NMT and SYNC by hand, so that every byte is the test's own."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus import Frame
from servod.runtime.fieldbus.cia import Abort, NmtCommand, Obj402
from servod.runtime.fieldbus.devices import DriveState

AMPLIFIER, ENCODER, MASTER = 1, 2, 126
JOINT: dict[str, Any] = {
    "inertia": 0.001,
    "friction": {
        "kind": "lugre",
        "sigma0": 950.0,
        "sigma1": 1.0,
        "viscous": 0.056,
        "coulomb": 0.045,
        "static": 0.07,
        "stribeck_velocity": 0.1,
    },
}
PERIOD_NS = 1_000_000


class AbortedError(Exception):
    """The node answered with an abort."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"{code:08X}")


class Bench:
    """The world and one connection; `heard` keeps every frame that came."""

    def __init__(self, joint: dict[str, Any] | None = None, **settings: Any) -> None:
        self.world = SteppedWorld(VirtualAxisSettings(**settings), AxisModel.model_validate(JOINT | (joint or {})))
        self.bus = self.world.connect()
        self.heard: list[Frame] = []

    def pass_time(self, seconds: float) -> list[Frame]:
        """Let time pass; what was heard meanwhile."""
        until_ns = self.world.clock.now_ns() + round(seconds * 1e9)
        got = []
        while (left_ns := until_ns - self.world.clock.now_ns()) > 0:
            frame = self.bus.receive(left_ns / 1e9)
            if frame is not None:
                got.append(frame)
        self.heard += got
        return got

    def frames(self, can_id: int) -> list[bytes]:
        """Data of all frames heard with this identifier."""
        return [f.data for f in self.heard if f.can_id == can_id]

    def request(self, node_id: int, data: bytes) -> bytes:
        """One SDO frame and its answer."""
        assert self.bus.send(0x600 + node_id, data.ljust(8, b"\0"))
        for _ in range(200):
            frame = self.bus.receive(0.01)
            if frame is None:
                break
            self.heard.append(frame)
            if frame.can_id == 0x580 + node_id:
                if frame.data[0] == 0x80:
                    raise AbortedError(int.from_bytes(frame.data[4:8], "little"))
                return frame.data
        raise TimeoutError("no SDO answer")

    def upload(self, node_id: int, index: int, subindex: int = 0) -> bytes:
        """Read, expedited or in segments."""
        answer = self.request(node_id, struct.pack("<BHB", 0x40, index, subindex))
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        value, toggle = b"", 0
        while True:
            answer = self.request(node_id, bytes((0x60 | toggle,)))
            value += answer[1 : 8 - (answer[0] >> 1 & 7)]
            toggle ^= 0x10
            if answer[0] & 1:
                return value

    def read(self, node_id: int, index: int, subindex: int = 0, *, signed: bool = False) -> int:
        """Read an integer."""
        return int.from_bytes(self.upload(node_id, index, subindex), "little", signed=signed)

    def write(self, node_id: int, index: int, subindex: int, value: int, size: int) -> None:
        """Write an integer of `size` bytes, expedited."""
        data = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
        self.request(node_id, struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex) + data)

    def write_segments(self, node_id: int, index: int, subindex: int, data: bytes) -> None:
        """Write bytes in segments."""
        self.request(node_id, struct.pack("<BHBI", 0x21, index, subindex, len(data)))
        toggle = 0
        for start in range(0, max(len(data), 1), 7):
            chunk = data[start : start + 7]
            last = start + 7 >= len(data)
            self.request(node_id, bytes((toggle | (7 - len(chunk)) << 1 | last,)) + chunk)
            toggle ^= 0x10

    def nmt(self, command: NmtCommand, node_id: int = 0) -> None:
        """Send an NMT command and let it act."""
        self.bus.send(0, bytes((command, node_id)))
        self.pass_time(0.002)

    def cycle(self, control: int | None = None, torque: int = 0, cycles: int = 1) -> None:
        """SYNC, then the RPDO (when `control` is given), then the rest of the period; as the loop does."""
        for _ in range(cycles):
            start_ns = self.world.clock.now_ns()
            self.bus.send(0x80, b"")
            self.pass_time(0.0005)
            if control is not None:
                self.bus.send(0x200 + AMPLIFIER, struct.pack("<Hh", control, torque))
            self.pass_time((start_ns + PERIOD_NS - self.world.clock.now_ns()) / 1e9)

    @property
    def state(self) -> DriveState:
        """The drive's state, from inside."""
        return self.world.amplifier.machine.state

    @property
    def torque_nm(self) -> float:
        """Torque on the joint, from inside."""
        return self.world.truth().torque_nm

    def operational(self) -> None:
        """Cyclic synchronous torque and NMT operational."""
        self.write(AMPLIFIER, Obj402.MODE, 0, 10, 1)
        self.nmt(NmtCommand.START)
        self.pass_time(0.01)

    def enabled(self) -> None:
        """All the way to operation enabled, over PDO."""
        self.operational()
        for word in (0x06, 0x07, 0x0F):
            self.cycle(word, cycles=3)
        assert self.state is DriveState.OPERATION_ENABLED

    def spinning(self, velocity_rad_s: float = 3.0) -> None:
        """Enabled, and moving."""
        self.enabled()
        self.world.devices.joint.plant.place(0.0, velocity_rad_s)
        self.cycle(0x0F, 2000, cycles=5)
        assert self.world.truth().velocity_rad_s > velocity_rad_s / 3


def abort_code(action: Callable[[], object]) -> Abort | int:
    """The abort code that `action` meets; 0 when it is accepted."""
    try:
        action()
    except AbortedError as error:
        return Abort(error.code) if error.code in Abort.__members__.values() else error.code
    return 0
