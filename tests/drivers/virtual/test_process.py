"""The process on its socket: canopen as an independent witness, python-can, wall clock, record, end."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import can
import canopen
import pytest

from servod import drivers
from servod.common.errors import BadInput, Unreachable
from servod.common.shipped import shipped
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.client import VirtualBus
from servod.drivers.virtual.drive_record import DriveRecord, read_drive_record
from servod.drivers.virtual.main import CanServer
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.formats.model.axis_model import load_axis_model
from servod.runtime.fieldbus.bus.socketcan import SocketCanBus
from servod.runtime.fieldbus.devices import DriveState

EDS = Path(drivers.__file__).parent / "eds"


class Axis:
    """The running process."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.bus, self.record = folder / "bus", folder / "drive.bin"
        command = [sys.executable, "-m", "servod.drivers.virtual.main", "--socket", str(self.bus)]
        command += ["--record", str(self.record), *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.ready = self.process.stdout.readline().rstrip("\n")
        assert self.ready.partition(" (without ")[0] == f"ready {self.bus}"


@pytest.fixture
def axis(tmp_path: Path) -> Iterator[Axis]:
    running = Axis(tmp_path)
    yield running
    running.process.kill()
    running.process.communicate()


@pytest.fixture
def network(axis: Axis) -> Iterator[canopen.Network]:
    net = canopen.Network()
    net.connect(interface="servod_virtual", channel=str(axis.bus))
    yield net
    net.disconnect()


def wait_for_state(amplifier: canopen.RemoteNode, masked: int) -> None:
    deadline = time.monotonic() + 5.0
    while amplifier.sdo[0x6041].raw & 0x6F != masked:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_canopen_scans_reads_configures_and_runs_the_axis(network: canopen.Network) -> None:
    network.scanner.search()
    time.sleep(0.3)
    assert network.scanner.nodes == [1, 2]
    amplifier = network.add_node(1, str(EDS / "amplifier.eds"))
    encoder = network.add_node(2, str(EDS / "encoder.eds"))
    assert amplifier.sdo[0x1008].raw == "servod virtual amplifier"
    assert encoder.sdo[0x1018][2].raw == 0x406
    amplifier.tpdo.read()
    amplifier.rpdo.read()
    amplifier.tpdo[3].clear()
    amplifier.tpdo[3].add_variable(0x606C)
    amplifier.tpdo[3].cob_id, amplifier.tpdo[3].trans_type, amplifier.tpdo[3].enabled = 0x381, 1, True
    amplifier.tpdo[3].save()
    amplifier.sdo[0x6060].raw = 10
    network.nmt.state = "OPERATIONAL"
    network.sync.start(0.005)
    for word, masked in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
        amplifier.rpdo[1][0x6040].raw = word
        amplifier.rpdo[1][0x6071].raw = 900 if word == 0x0F else 0
        amplifier.rpdo[1].transmit()
        wait_for_state(amplifier, masked)
    encoder.tpdo.read()
    first = encoder.sdo[0x6004].raw
    assert amplifier.tpdo[3].wait_for_reception(1.0) is not None
    time.sleep(0.2)
    assert encoder.sdo[0x6004].raw > first + 1000
    assert amplifier.tpdo[3][0x606C].raw > 0
    network.sync.stop()


def test_canopen_reads_the_dictionary_from_the_node(network: canopen.Network) -> None:
    node = network.add_node(2, str(EDS / "encoder.eds"))
    with node.sdo[0x1021].open("rb", block_transfer=True, buffering=7) as file:
        assert file.read() == (EDS / "encoder.eds").read_bytes()


def test_frames_of_a_client_that_closes_at_once_go_out(axis: Axis) -> None:
    """The frames are in the controller's queue: that their sender ended, with frames unread, takes none back."""
    listener = VirtualBus(str(axis.bus), can_ids=(0x123,))
    for burst in range(30):
        leaver = VirtualBus(str(axis.bus))
        assert listener.send(0x124, b"unread")
        for number in range(10):
            assert leaver.send(0x123, bytes((burst, number)))
        leaver.close()
        heard = [listener.receive(1.0) for _ in range(10)]
        assert [frame[1] for frame in heard if frame] == [bytes((burst, number)) for number in range(10)]
    listener.close()


def test_tools_see_the_same_frames(axis: Axis) -> None:
    with can.Bus(interface="servod_virtual", channel=str(axis.bus)) as viewer:
        bus = VirtualBus(str(axis.bus))
        assert bus.send(0x123, b"abc")
        message = viewer.recv(1.0)
        assert message is not None
        assert (message.arbitration_id, bytes(message.data)) == (0x123, b"abc")
        assert abs(message.timestamp - time.time()) < 1.0
        viewer.send(can.Message(arbitration_id=0x321, data=b"xy", is_extended_id=False), timeout=1.0)
        frame = bus.receive(1.0)
        assert frame is not None
        assert (frame.can_id, frame.data) == (0x321, b"xy")
        bus.close()


def test_a_filtered_connection_gets_only_its_identifiers(axis: Axis) -> None:
    filtered, sender = VirtualBus(str(axis.bus), (0x200,)), VirtualBus(str(axis.bus))
    time.sleep(0.05)
    for can_id in (0x100, 0x200, 0x300):
        sender.send(can_id, b"")
    heard = set()
    while (frame := filtered.receive(0.5)) is not None:
        heard.add(frame.can_id)
    assert heard - {0x701, 0x702} == {0x200}  # boot-ups may come before the hub has read the filter


def test_bus_off_reaches_the_client_as_an_error_frame(axis: Axis) -> None:
    bus = VirtualBus(str(axis.bus))
    bus.inject(BusFault(FaultKind.BUS_OFF))
    deadline = time.monotonic() + 2.0
    while not bus.counters.bus_off and time.monotonic() < deadline:
        bus.receive(0.1)
    assert bus.counters.bus_off
    assert bus.counters.error_frames == 1
    assert not bus.send(0x80, b"")


def test_a_hub_that_dies_is_a_state_and_no_exception(axis: Axis) -> None:
    bus = VirtualBus(str(axis.bus))
    axis.process.kill()
    axis.process.wait()
    start = time.monotonic()
    assert bus.receive(0.1) is None
    assert bus.counters.down
    assert not bus.send(0x80, b"")
    assert bus.receive(0.1) is None
    assert time.monotonic() - start > 0.05  # waiting stays waiting


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_cleanly(axis: Axis, number: int) -> None:
    axis.process.send_signal(number)
    _, errors = axis.process.communicate(timeout=5)
    assert (axis.process.returncode, errors) == (0, "")
    assert not axis.bus.exists()


def test_its_emergency_stop_and_its_sto_circuit_are_turned_by_signals(axis: Axis, network: canopen.Network) -> None:
    amplifier = network.add_node(1, str(EDS / "amplifier.eds"))

    def wait_for(circuits: int) -> None:
        deadline = time.monotonic() + 5.0
        while amplifier.sdo[0x60FD].raw & 0x30000 != circuits:
            assert time.monotonic() < deadline
            time.sleep(0.005)

    wait_for(0x30000)
    for number, turned in ((signal.SIGUSR1, 0x20000), (signal.SIGUSR2, 0x10000)):
        axis.process.send_signal(number)
        wait_for(turned)
        axis.process.send_signal(number)
        wait_for(0x30000)


def test_the_drive_record_survives_a_kill(axis: Axis) -> None:
    bus = VirtualBus(str(axis.bus))
    bus.send(0x601, bytes.fromhex("2b40600006000000"))
    assert bus.receive(1.0) is not None
    time.sleep(0.05)
    axis.process.kill()
    axis.process.wait()
    samples = read_drive_record(axis.record)
    assert samples[0].state is DriveState.SWITCH_ON_DISABLED
    assert samples[-1].state is DriveState.READY_TO_SWITCH_ON
    assert samples[-1].control_word == 6
    assert all(a.time_ns <= b.time_ns + 2_000_000 for a, b in itertools.pairwise(samples))


def test_the_record_is_a_ring(tmp_path: Path) -> None:
    record = DriveRecord(tmp_path / "ring", capacity=3)
    for n in range(5):
        record.write((n, 2, 0x40, 0, 10, 0.0, 0.0, 0.0, 0.0))
    assert [sample.time_ns for sample in read_drive_record(tmp_path / "ring")] == [2, 3, 4]
    record.close()
    (tmp_path / "other").write_bytes(b"something else entirely")
    with pytest.raises(BadInput):
        read_drive_record(tmp_path / "other")


def test_a_record_for_which_there_is_no_room_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    """The limit on the size of files stands for the disk's end; a map without room would end the process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(BadInput, match="file too large"):
            DriveRecord(tmp_path / "ring")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())


def test_no_hub_is_unreachable(tmp_path: Path) -> None:
    with pytest.raises(Unreachable):
        VirtualBus(str(tmp_path / "nothing"))
    with pytest.raises(can.CanInitializationError):
        can.Bus(interface="servod_virtual", channel=str(tmp_path / "nothing"))


def test_a_served_socket_is_refused_and_a_dead_one_replaced(axis: Axis, tmp_path: Path) -> None:
    second = [sys.executable, "-m", "servod.drivers.virtual.main", "--socket", str(axis.bus)]
    result = subprocess.run(second, capture_output=True, text=True, timeout=30)
    assert result.returncode == 3
    assert result.stderr.count("\n") == 1
    dead = tmp_path / "dead"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
        left.bind(str(dead))
    folder = tmp_path / "other"
    folder.mkdir()
    dead.rename(folder / "bus")
    again = Axis(folder, "--timing", "paced")
    again.process.terminate()
    assert again.process.wait(5) == 0


def test_paced_timing_waits_for_the_bus(tmp_path: Path) -> None:
    running = Axis(tmp_path, "--timing", "paced", "--bit-rate", "10000")
    try:
        sender, receiver = VirtualBus(str(running.bus)), VirtualBus(str(running.bus))
        time.sleep(0.1)
        while receiver.receive(0.05):
            pass
        start = time.monotonic()
        sender.send(0x123, bytes(8))
        assert receiver.receive(1.0) is not None
        assert time.monotonic() - start >= 0.0135
    finally:
        running.process.kill()
        running.process.communicate()


def test_a_busy_bus_makes_send_fail_without_blocking(tmp_path: Path) -> None:
    running = Axis(tmp_path, "--bit-rate", "10000")
    try:
        bus = VirtualBus(str(running.bus))
        start = time.monotonic()
        accepted = [bus.send(0x7FF, bytes(8)) for _ in range(2000)]
        assert time.monotonic() - start < 1.0
        assert accepted[0]
        assert not accepted[-1]
        assert bus.counters.queue_full == accepted.count(False)
        assert bus.counters.sent == accepted.count(True)
    finally:
        running.process.kill()
        running.process.communicate()


def test_a_tool_waits_for_a_busy_bus(tmp_path: Path) -> None:
    running = Axis(tmp_path, "--bit-rate", "50000")
    frame = can.Message(arbitration_id=0x7FF, data=bytes(8), is_extended_id=False)
    try:
        with can.Bus(interface="servod_virtual", channel=str(running.bus)) as bus:
            for _ in range(300):
                bus.send(frame)
            with pytest.raises(can.CanOperationError, match="queue full"):
                for _ in range(2000):
                    bus.send(frame, timeout=0.0)
    finally:
        running.process.kill()
        running.process.communicate()


def test_it_asks_for_real_time_by_itself(axis: Axis, tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    left = Axis(tmp_path / "left", "--priority", "0")
    try:
        assert os.sched_getscheduler(left.process.pid) == os.SCHED_OTHER
        if os.sched_getscheduler(axis.process.pid) == os.SCHED_FIFO:
            assert os.sched_getparam(axis.process.pid).sched_priority == 40
        else:
            assert "SCHED_FIFO 40" in axis.ready
    finally:
        left.process.kill()
        left.process.communicate()


#: Runs a virtual axis until it is told to end, and says how its process is scheduled then.
ENDS = """
import os, sys
from servod.drivers.virtual.main import main
code = main(sys.argv[1:])
print(code, os.sched_getscheduler(0))
"""


def test_it_lets_others_run_while_it_ends(tmp_path: Path) -> None:
    """An interpreter takes 30 ms for that: too long for another axis on this processor to wait."""
    words = [sys.executable, "-c", ENDS, "--socket", str(tmp_path / "bus")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as axis:
        assert axis.stdout is not None and axis.stdout.readline().startswith("ready ")
        axis.terminate()
        assert axis.stdout.read() == f"0 {os.SCHED_OTHER}\n"


@pytest.mark.parametrize(
    ("options", "code", "named"),
    [
        ([], 2, "one of the arguments --socket --can is required"),
        (["--socket", "{folder}/bus", "--seed", "x"], 2, "--seed: invalid int value"),
        (["--can", "nosuchcan0"], 3, "nosuchcan0"),
        (["--socket", "{folder}/no/such/folder/bus"], 2, "found no folder "),
        (["--socket", "{folder}/bus", "--plant", "{folder}/missing.yaml"], 2, "missing.yaml"),
        (["--socket", "{folder}/bus", "--plant", "{folder}/slide.yaml"], 2, "slide.yaml: axis: found linear"),
        (["--socket", "{folder}/bus", "--settings", "{folder}/settings.yaml"], 2, "rated_torque_mnm"),
        (["--socket", "{folder}/bus", "--seed", "-1"], 2, "seed"),
        (["--socket", "{folder}/bus", "--encoder-node-id", "1"], 2, "node_id"),
        (["--socket", "{folder}/bus", "--record", "{folder}/no/record"], 2, "no/record"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, options: list[str], code: int, named: str) -> None:
    (tmp_path / "settings.yaml").write_text("rated_torque: 100\n")
    (tmp_path / "slide.yaml").write_text("axis: linear\ninertia: 9\nfriction: {kind: coulomb_viscous}\n")
    command = [sys.executable, "-m", "servod.drivers.virtual.main", *(o.format(folder=tmp_path) for o in options)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=30)
    assert result.returncode == code
    assert result.stderr.count("\n") == 1
    assert named in result.stderr
    assert result.stderr.startswith("servod-virtual-axis: ")


def test_the_same_nodes_on_socketcan_sockets() -> None:
    """Two packet sockets of `struct can_frame` stand for two controllers on vcan."""
    ends = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
    masters = [SocketCanBus(end[0]) for end in ends]
    model = load_axis_model(shipped("gains/axes/demo_joint.yaml"))
    server = CanServer(VirtualAxisSettings(), model, (SocketCanBus(ends[0][1]), SocketCanBus(ends[1][1])), None)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        for master, node_id, device_type in zip(masters, (1, 2), (0x192, 0x196), strict=True):
            boot = master.receive(5.0)
            assert boot is not None
            assert (boot.can_id, boot.data) == (0x700 + node_id, b"\0")
            master.send(0x600 + node_id, bytes.fromhex("4000100000000000"))
            answer = master.receive(5.0)
            assert answer is not None
            assert answer.data[4:6] == device_type.to_bytes(2, "little")
    finally:
        server.stop()
        thread.join(5.0)
        server.close()
        for master in masters:
            master.close()
