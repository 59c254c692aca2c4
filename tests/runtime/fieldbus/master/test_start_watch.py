"""Whoever else speaks while the nodes are set up ends the start: what he writes may come behind our reading back."""

from __future__ import annotations

import pytest

from servod.client.stepped import SteppedSession
from servod.common.errors import Unreachable
from servod.common.shipped import shipped
from servod.drivers.virtual.world import SteppedWorld, VirtualAxisSettings
from servod.formats.config import AxisConfig, load_config
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import NmtState
from servod.runtime.fieldbus.master import Master, master_ids, start_ids
from servod.runtime.fieldbus.master.network import BusNetwork

FRAMES = {
    "NMT to a node of ours": (0x000, "0101"),
    "SYNC": (0x080, ""),
    "command": (0x201, "0F000000"),
    "PDO to the encoder": (0x302, "00"),
    "heartbeat of the master": (0x77E, "05"),
    "EMCY of the master": (0x0FE, "1023810000000000"),
    "polarity, by SDO": (0x601, "2F7E600020000000"),
    "read of the encoder, by SDO": (0x602, "4000100000000000"),
}


class Between:
    """Sends a frame by a connection of its own right before the master's transfer of that number."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, number: int, can_id: int, data: str) -> None:
        self.sent, self._number, self._frame = 0, number, (can_id, bytes.fromhex(data))
        self.bus: Bus | None = None
        send = BusNetwork.send_message

        def send_behind_it(network: BusNetwork, *frame: object, **options: bool) -> None:
            if self.sent == self._number and self.bus is not None:
                self.bus.send(*self._frame)
                network.wait(lambda: False, 1e-3)
            self.sent += 1
            send(network, *frame, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(BusNetwork, "send_message", send_behind_it)


def config() -> AxisConfig:
    return load_config(shipped("gains/config/virtual.yaml"))


def world() -> SteppedWorld:
    return SteppedWorld(VirtualAxisSettings(), load_axis_model(shipped("gains/axes/demo_joint.yaml")))


def start(there: SteppedWorld) -> SteppedSession:
    gains = load_gains(shipped("gains/demo_pd.yaml"))
    return SteppedSession(config(), there, gains.law.number, gains.pack())


@pytest.fixture(scope="module")
def transfers() -> int:
    """How many frames a bring-up sends."""
    with pytest.MonkeyPatch.context() as patched:
        counted = Between(patched, -1, 0, "")
        start(world())
    return counted.sent


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
@pytest.mark.parametrize("kind", FRAMES)
def test_the_start_ends_whenever_it_comes(kind: str, share: float, transfers: int, monkeypatch) -> None:
    there = world()
    attack = Between(monkeypatch, round(share * (transfers - 1)), *FRAMES[kind])
    attack.bus = there.connect()
    with pytest.raises(Unreachable, match="somebody else spoke on the bus while the nodes were set up"):
        start(there)
    there.clock.sleep_until(there.clock.now_ns() + 5_000_000)
    assert {node.state for node in (there.amplifier, there.encoder)} == {NmtState.PRE_OPERATIONAL}


@pytest.mark.parametrize("kind", FRAMES)
@pytest.mark.parametrize("began_s", [None, -0.001, 0.002])
def test_the_loops_own_first_frames_are_no_stranger(kind: str, began_s: float | None) -> None:
    """A machine that stood still looks when the loop has begun since: what the loop sends is no stranger's.

    `began_s`: after the frame; one that came before the loop began is a stranger's whatever it is.
    """
    there, axis = world(), config()
    master_bus, start_bus, loop = there.connect(master_ids(axis)), there.connect(start_ids(axis)), there.connect()
    master = Master(axis, master_bus, there.clock, threaded=False, start_bus=start_bus)
    there.clock.sleep_until(there.clock.now_ns() + 5_000_000)
    began_ns = None if began_s is None else there.clock.now_ns() + round(1e9 * began_s)
    loop.send(FRAMES[kind][0], bytes.fromhex(FRAMES[kind][1]))
    there.clock.sleep_until(there.clock.now_ns() + 4_000_000)
    if began_s == -0.001 and kind in ("SYNC", "command", "heartbeat of the master"):
        master.look_for_foreign_traffic(lambda: began_ns)
    else:
        with pytest.raises(Unreachable, match="somebody else spoke"):
            master.look_for_foreign_traffic(lambda: began_ns)
