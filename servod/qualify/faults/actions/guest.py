"""Actions of the guest machine: its interface, its clock, its disk, and can-utils as a stranger on its bus.

They touch the whole machine, so that they run nowhere else (tests/guest).
"""

from __future__ import annotations

import os
import subprocess
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from servod.common.errors import Unreachable
from servod.qualify.faults.actions.processes import ProcessAction
from servod.qualify.faults.scenario import Loss, Runs
from servod.qualify.faults.wire import CanWire

if TYPE_CHECKING:
    from servod.qualify.faults.actions.base import InjectionAction
    from servod.qualify.faults.processes import ProcessAxis

#: Stands on the kernel's command line of the guest, and of no other machine.
_GUEST_MARK = "servod.share="
_LONGEST_S = 30.0
#: netdevice(7): the interface is up.
_IFF_UP = 0x1
#: A clock that was set is where it should be, but for the time that setting it takes [s].
_CLOCK_S = 30.0


def _run(*command: str) -> None:
    """Run a program of the guest; raises Unreachable with what it said, and on every machine that is no guest."""
    if _GUEST_MARK not in Path("/proc/cmdline").read_text(encoding="utf-8"):
        raise Unreachable(f"{command[0]}: only in the guest machine")
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_LONGEST_S, check=False
    )
    if done.returncode not in (0, 124):  # timeout(1) has ended it
        raise Unreachable(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")


def _flags(interface: str) -> Path:
    return Path("/sys/class/net") / interface / "flags"


class GuestAction(ProcessAction):
    """An action for which there must be a whole machine."""

    runs: ClassVar[frozenset[Runs]] = frozenset({Runs.GUEST})


class InterfaceChange(StrEnum):
    """What becomes of the CAN interface."""

    DOWN = "down"
    UP = "up"
    GONE = "gone"  # the adapter is pulled out
    BACK = "back"  # and put in again


class Interface(GuestAction):
    """Somebody takes the interface down, or pulls its adapter; or brings it back."""

    do: InterfaceChange

    def loss(self) -> Loss:
        """Without an interface there is no bus."""
        return Loss.MASTER if self.do in (InterfaceChange.DOWN, InterfaceChange.GONE) else Loss.NONE

    def act(self, axis: ProcessAxis) -> int:
        """Change it by ip(8), and see what the kernel has then."""
        assert isinstance(axis.wire, CanWire)
        name, goes_up = axis.wire.interface, self.do in (InterfaceChange.UP, InterfaceChange.BACK)
        if self.do is InterfaceChange.GONE:
            _run("ip", "link", "delete", name)
            return not _flags(name).exists()
        if self.do is InterfaceChange.BACK:
            _run("ip", "link", "add", "dev", name, "type", "vcan")
        _run("ip", "link", "set", name, "up" if goes_up else "down")
        return bool(int(_flags(name).read_text(encoding="utf-8"), 16) & _IFF_UP) is goes_up


class SetClock(GuestAction):
    """Somebody, or a time server, sets the wall clock."""

    by_s: int = Field(ge=-10_000_000, le=10_000_000)

    def act(self, axis: ProcessAxis) -> int:
        """Set it by date(1)."""
        before_s = time.time() - time.monotonic()
        _run("date", "-s", f"{self.by_s:+d} seconds")
        return abs(time.time() - time.monotonic() - before_s - self.by_s) < _CLOCK_S


class SmallDisk(GuestAction):
    """The recordings stand on a disk of `kib`, which is as good as full."""

    kib: int = Field(ge=16)

    def act(self, axis: ProcessAxis) -> int:
        """Mount it where the daemon sees it: its folders are shared with the machine's."""
        folder = str(axis.config.recorder.directory)
        _run("install", "-d", "-o", "servod", "-g", "servod", folder)
        _run("mount", "-t", "tmpfs", "-o", f"size={self.kib}k,mode=1777", "none", folder)
        return os.path.ismount(folder)


class DiskBack(GuestAction):
    """The small disk is taken away again."""

    def act(self, axis: ProcessAxis) -> int:
        """Unmount it, also from under open files."""
        folder = str(axis.config.recorder.directory)
        _run("umount", "--lazy", folder)
        return not os.path.ismount(folder)


class CanSend(GuestAction):
    """A stranger sends one frame by cansend(1), for example `080#` or `701#00`."""

    frame: str = Field(pattern=r"^[0-9A-F]{3}#[0-9A-F]{0,16}$")

    def loss(self) -> Loss:
        """NMT commands other than start take a node out of operational."""
        return Loss.FEEDBACK if self.frame.startswith("000#") and self.frame[4:6] != "01" else Loss.NONE

    def act(self, axis: ProcessAxis) -> int:
        """Send it; cansend(1) fails when the interface does not take it."""
        assert isinstance(axis.wire, CanWire)
        _run("cansend", axis.wire.interface, self.frame)
        return 1


class CanGen(GuestAction):
    """A stranger sends frame after frame by cangen(1)."""

    can_id: str = Field(pattern=r"^[0-9A-F]{3}$")
    length: int = Field(8, ge=0, le=8)
    gap_ms: float = Field(ge=0.0, le=1000.0)
    for_ms: int = Field(ge=100, le=10_000)

    def act(self, axis: ProcessAxis) -> int:
        """Let it run for its time; cangen(1) fails when the interface does not take its frames."""
        assert isinstance(axis.wire, CanWire)
        frames = ["-I", self.can_id, "-L", str(self.length), "-g", str(self.gap_ms), "-i"]
        _run("timeout", str(self.for_ms / 1e3), "cangen", axis.wire.interface, *frames)
        return 1


GUEST_ACTIONS: dict[str, type[InjectionAction]] = {
    "interface": Interface,
    "set_clock": SetClock,
    "small_disk": SmallDisk,
    "disk_back": DiskBack,
    "cansend": CanSend,
    "cangen": CanGen,
}
