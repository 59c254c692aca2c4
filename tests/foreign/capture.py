"""What passes on the virtual bus as a file that Wireshark reads, and what its CANopen dissector says of it."""

from __future__ import annotations

import struct
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from servod.drivers.virtual.client import VirtualBus
from servod.runtime.fieldbus.bus import Frame

_LINKTYPE_CAN_SOCKETCAN = 227
_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, _LINKTYPE_CAN_SOCKETCAN)


def packet(frame: Frame) -> bytes:
    """One frame with its time as a record of libpcap's file; the identifier has the order of the network."""
    content = struct.pack(">IB3x", frame.can_id, len(frame.data)) + frame.data
    seconds, rest_ns = divmod(frame.time_ns, 1_000_000_000)
    return struct.pack("<IIII", seconds, rest_ns // 1000, len(content), len(content)) + content


@contextmanager
def captured(bus: Path, file: Path) -> Iterator[None]:
    """Write every frame on the bus to `file` for the time of a `with` block; fails when one was missed."""
    witness, over = VirtualBus(str(bus)), threading.Event()
    with file.open("wb") as output:
        output.write(_HEADER)

        def write() -> None:
            while not over.is_set():
                if frame := witness.receive(0.05):
                    output.write(packet(frame))
            while frame := witness.receive():  # what waits at the end; heartbeats never end
                output.write(packet(frame))

        thread = threading.Thread(target=write)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            witness.close()
    assert witness.counters.error_frames == 0, "the hub says that the witness read too slowly"


def write_frames(file: Path, frames: list[tuple[int, bytes]]) -> None:
    """A file of these frames alone, a millisecond apart."""
    file.write_bytes(_HEADER + b"".join(packet(Frame(i, data, n * 10**6)) for n, (i, data) in enumerate(frames)))


def dissected(file: Path, wanted: str = "canopen") -> list[str]:
    """What tshark says in a line of each frame that the filter `wanted` shows, CANopen expected."""
    command = ["tshark", "-r", str(file), "-d", "can.subdissector,canopen", "-Y", wanted]
    command += ["-T", "fields", "-e", "_ws.col.Protocol", "-e", "_ws.col.Info"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def kinds(lines: list[str]) -> Counter[str]:
    """How many frames there are of each protocol of CANopen, by the dissector's own words."""
    return Counter(line.partition("\t")[2].strip().split()[0] for line in lines)
