"""Every frame of a whole session through Wireshark's CANopen dissector: none is malformed, none unknown to it."""

from __future__ import annotations

import base64
import re
import time
from pathlib import Path

import pytest

from tests.foreign.canopennode import Gateway, party
from tests.foreign.capture import captured, dissected, kinds, write_frames
from tests.foreign.daemon import configured, daemon, virtual_axis


@pytest.mark.parametrize(
    "short",
    [(0x000, b"\x01"), (0x081, b"\x30\x81"), (0x581, b"\x43\x00"), (0x601, b"\x40")],
    ids=["NMT", "EMCY", "answer", "request"],
)
def test_the_dissector_finds_a_frame_that_is_too_short(tmp_path: Path, short: tuple[int, bytes]) -> None:
    write_frames(tmp_path / "bent.pcap", [(0x701, b"\x05"), short, (0x080, b"")])
    assert len(dissected(tmp_path / "bent.pcap")) == 3
    assert len(dissected(tmp_path / "bent.pcap", "_ws.malformed")) == 1


def check(file: Path) -> list[str]:
    """All frames are CANopen, none is malformed or not known; gives what the dissector says of each.

    It keeps no state: the segments of a block, which begin with their number, it takes for commands.
    """
    lines = dissected(file, "frame")
    told = [line for line in lines if not re.search(r"Default-SDO \(.x\): Unknown \(0x7\)", line)]
    assert [line for line in told if not line.startswith("CANopen\t") or "Unknown" in line] == []
    assert len(lines) - len(told) <= 4, "no more than ends of blocks"
    assert dissected(file, "_ws.malformed || _ws.expert.severity >= warning") == []
    return lines


def test_a_session_of_servod(tmp_path: Path) -> None:
    config, pcap = configured(tmp_path), tmp_path / "session.pcap"
    with virtual_axis(tmp_path) as bus, captured(bus, pcap), daemon(config) as (client, _):
        client.call("enable")
        client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=1.0, duration_s=1.0)
        time.sleep(1.2)
        client.call("stop")
        client.call("scan")
    found = kinds(check(pcap))
    assert min(found[kind] for kind in ("SYNC", "PDO1", "PDO2")) > 1000, found
    assert min(found[kind] for kind in ("Default-SDO", "NMT:", "NMT")) >= 4, found


def test_a_session_of_canopennode(built: Path, tmp_path: Path) -> None:
    pcap = tmp_path / "session.pcap"
    with (
        virtual_axis(tmp_path) as bus,
        captured(bus, pcap),
        party(built, "canopend", bus, 100, tmp_path, ("-c", "stdio")) as canopend,
    ):
        gateway = Gateway(canopend)
        for block in (0, 1):
            gateway.ask(f"set sdo_block {block}")
            gateway.read(2, 0x1021, 0, "d")
            gateway.write(1, 0x2004, 0, "d", base64.b64encode(bytes(range(256)) * 3).decode())
            gateway.refusal("1 r 0x7000 0 u32")
        gateway.write(1, 0x1016, 1, "u32", 100 << 16 | 100)
        gateway.write(100, 0x1017, 0, "u16", 20)
        time.sleep(0.1)
        gateway.write(100, 0x1017, 0, "u16", 0)
        canopend.wait_for("errorCode=0x8130")
        for command in ("start", "stop", "preop", "reset comm", "reset node"):
            gateway.ask(f"1 {command}")
        gateway.ask("lss_switch_sel 0x5EBD 0x406 0x10000 2")
        gateway.ask("lss_get_node")
        gateway.ask("lss_switch_glob 0")
    found = kinds(check(pcap))
    assert min(found[kind] for kind in ("Default-SDO", "NMT:", "NMT", "EMCY", "LSS")) >= 1, found
    assert found["Default-SDO"] > 1000, "long transfers by segments and blocks"
