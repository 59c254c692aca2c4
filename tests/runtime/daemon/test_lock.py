"""Locks of bus and control socket: files that strangers cannot hold, and one line on who does."""

from __future__ import annotations

import hashlib
import os
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from daemon_rows import axis_config

from servod.common.errors import Unreachable
from servod.formats.config import BusConfig
from servod.runtime.daemon import lock
from servod.runtime.daemon.lock import BusLock, InstanceLock

CAN = BusConfig(interface="socketcan", channel="can0")


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The service's folder, which is nowhere on a machine that develops; and no folder of a login."""
    with tempfile.TemporaryDirectory(prefix="servod-lock-") as folder:
        run = Path(folder) / "run"
        run.mkdir()
        for one in (run.parent, run):  # pytest's own folders let nobody else in
            one.chmod(0o755)
        monkeypatch.setattr(lock, "RUNTIME_FOLDER", run)
        monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        yield run


def test_second_daemon_on_socket_or_bus_is_refused(tmp_path: Path) -> None:
    first = InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1"))
    for path, channel in (("a.sock", "bus2"), ("b.sock", "bus1")):
        with pytest.raises(Unreachable, match=r"another servod \(process [0-9]+\)"):
            InstanceLock(axis_config(tmp_path / path, tmp_path / channel))
    InstanceLock(axis_config(tmp_path / "b.sock", tmp_path / "bus2")).release()
    first.release()
    with BusLock(BusConfig(channel=str(tmp_path / "bus1"))), pytest.raises(Unreachable, match="another servod"):
        InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1"))
    InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1")).release()


def test_other_bus_than_a_virtual_one_is_locked_in_the_runtime_folder(runtime: Path) -> None:
    with BusLock(CAN):
        with pytest.raises(Unreachable, match=rf"bus socketcan can0: another servod \(process {os.getpid()}\) owns it"):
            BusLock(CAN)
        with BusLock(BusConfig(interface="socketcan", channel="can1")):
            pass
    with BusLock(CAN):
        pass


@pytest.mark.parametrize("command", [BusLock, partial(InstanceLock, passing=True)])
def test_a_command_that_comes_and_goes_takes_away_the_files_that_it_made(
    command: Callable[..., BusLock | InstanceLock], tmp_path: Path
) -> None:
    axis = axis_config(tmp_path / "new" / "a.sock", tmp_path / "new" / "deep" / "bus")
    given = axis.bus if command is BusLock else axis
    with command(given):
        assert (tmp_path / "new" / "deep" / "bus.lock").exists()
    assert not [entry for entry in tmp_path.rglob("*") if entry.is_file()]
    assert (tmp_path / "new" / "deep").is_dir(), "somebody else may rely on it by now"
    InstanceLock(axis).release()
    with command(given):
        pass
    assert (tmp_path / "new" / "a.sock.lock").exists() and (tmp_path / "new" / "deep" / "bus.lock").exists()


def test_a_lock_on_a_file_that_was_taken_away_meanwhile_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another gives its lock back, and takes the file away, between our opening and our locking."""
    bus = BusConfig(channel=str(tmp_path / "bus"))
    other, opened = BusLock(bus), lock._open

    def late(path: Path) -> tuple[int, bool]:
        file, made = opened(path)
        other.release()
        return file, made

    monkeypatch.setattr(lock, "_open", late)
    with BusLock(bus), pytest.raises(Unreachable, match="owns it"):
        BusLock(bus)
    assert not (tmp_path / "bus.lock").exists(), "whoever made the file at last takes it away"


def test_nobody_outside_the_group_may_open_a_lock(runtime: Path) -> None:
    axis = axis_config(runtime / "axis.sock", runtime / "vbus0")
    before = os.umask(0)
    try:
        with InstanceLock(axis), BusLock(CAN):
            made = sorted(runtime.glob("*.lock"))
            rights = {stat.S_IMODE(path.stat().st_mode) for path in made}
    finally:
        os.umask(before)
    assert [path.name.split("-")[0] for path in made] == ["axis.sock.lock", "bus", "vbus0.lock"]
    assert rights == {0o660}


def test_abstract_name_that_somebody_binds_keeps_no_daemon_from_its_start(runtime: Path) -> None:
    name = "\0servod-" + hashlib.sha256(b"bus socketcan can0").hexdigest()[:32]
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.bind(name)
        with BusLock(CAN):
            pass


def test_killed_holder_leaves_a_file_and_no_lock(runtime: Path) -> None:
    file = runtime / "vbus0.lock"
    bus = BusConfig(interface="virtual", channel=str(runtime / "vbus0"))
    code = (
        "import os, sys; from servod.formats.config import BusConfig; from servod.runtime.daemon.lock import BusLock\n"
        "kept = BusLock(BusConfig(interface='virtual', channel=sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", code, bus.channel])
    assert done.returncode == -9 and file.read_text().strip().isdigit()
    with BusLock(bus):
        assert file.read_text().strip() == str(os.getpid())


def test_lock_whose_file_somebody_removed_is_made_again(tmp_path: Path) -> None:
    with InstanceLock(axis_config(tmp_path / "a.sock", tmp_path / "bus1")) as kept:
        for file in tmp_path.glob("*.lock"):
            file.unlink()
        kept.keep()
        with pytest.raises(Unreachable, match=rf"process {os.getpid()}\) owns it"):
            BusLock(BusConfig(channel=str(tmp_path / "bus1")))
        (tmp_path / "bus1.lock").unlink()
        with BusLock(BusConfig(channel=str(tmp_path / "bus1"))), pytest.raises(Unreachable, match="owns it"):
            kept.keep()


def test_folder_of_the_login_serves_an_adapter_and_no_interface_of_the_machine(
    runtime: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    own.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(own))
    runtime.rmdir()
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with BusLock(BusConfig(interface="slcan", channel="/dev/ttyACM0")):
        assert len(list(own.glob("bus-slcan-*.lock"))) == 1
    with pytest.raises(Unreachable, match=r"nothing may be written in .*run as the user servod"):
        BusLock(CAN)
    assert not list(own.glob("bus-socketcan-*")), "another user's daemon would not see it"


#: Another user than the one whose folder it is.
_AS_STRANGER = """
import os, sys
os.chdir("/")
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from servod.formats.config import BusConfig
from servod.runtime.daemon import lock
from servod.common.errors import Unreachable
lock.RUNTIME_FOLDER = Path(sys.argv[1])
os.environ.pop("XDG_RUNTIME_DIR", None)
bus = BusConfig(interface="socketcan", channel="can0")
def attempt():
    try:
        lock.BusLock(bus).release()
        print("free")
    except Unreachable as error:
        print(error)
if os.geteuid() == 0:
    os.setgroups([])
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
attempt()
"""


def test_files_that_may_not_be_opened_are_told_with_their_owner_in_one_line(runtime: Path) -> None:
    os.close(lock._taken(*lock._of_bus(CAN))[0])  # as a daemon leaves it
    (file,) = runtime.glob("*.lock")
    if os.geteuid() != 0:  # nobody to change to: a file that not even its owner may open
        file.chmod(0)

    def said() -> str:
        command = [sys.executable, "-c", _AS_STRANGER, str(runtime), str(Path(lock.__file__).parents[3])]
        return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()

    owner = file.owner()
    told = f"bus socketcan can0: its lock {file}, which belongs to user {owner}, cannot be opened (permission denied)"
    assert said() == told
    file.unlink()
    runtime.chmod(0o500)
    assert said() == (
        f"bus socketcan can0: no lock for it, for nothing may be written in {runtime}; run as the user servod, or "
        f'where the service is not installed: sudo install -d -o "$USER" {runtime}'
    )
