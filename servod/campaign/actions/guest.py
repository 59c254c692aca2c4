"""Actions of the guest machine: its interface, its clock, its disk, and can-utils as a stranger on its bus.

They touch the whole machine, so that they run nowhere else (tests/guest).
"""

from __future__ import annotations

import subprocess
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from servod.campaign.actions.processes import ProcessAction
from servod.campaign.scenario import Loss, Runs
from servod.campaign.wire import CanWire
from servod.errors import Unreachable

if TYPE_CHECKING:
    from servod.campaign.actions.base import Action
    from servod.campaign.processes import ProcessAxis

#: Stands on the kernel's command line of the guest, and of no other machine.
_GUEST_MARK = "servod.share="
_LONGEST_S = 30.0


def _run(*command: str) -> None:
    """Run a program of the guest; raises Unreachable with what it said, and on every machine that is no guest."""
    if _GUEST_MARK not in Path("/proc/cmdline").read_text():
        raise Unreachable(f"{command[0]}: only in the guest machine")
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_LONGEST_S, check=False
    )
    if done.returncode not in (0, 124):  # timeout(1) has ended it
        raise Unreachable(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")


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

    def act(self, axis: ProcessAxis) -> None:
        """Change it by ip(8)."""
        assert isinstance(axis.wire, CanWire)
        name = axis.wire.interface
        if self.do is InterfaceChange.GONE:
            _run("ip", "link", "delete", name)
            return
        if self.do is InterfaceChange.BACK:
            _run("ip", "link", "add", "dev", name, "type", "vcan")
        _run("ip", "link", "set", name, "down" if self.do is InterfaceChange.DOWN else "up")


class SetClock(GuestAction):
    """Somebody, or a time server, sets the wall clock."""

    by_s: int = Field(ge=-10_000_000, le=10_000_000)

    def act(self, axis: ProcessAxis) -> None:
        """Set it by date(1)."""
        _run("date", "-s", f"{self.by_s:+d} seconds")


class SmallDisk(GuestAction):
    """The recordings stand on a disk of `kib`, which is as good as full."""

    kib: int = Field(ge=16)

    def act(self, axis: ProcessAxis) -> None:
        """Mount it where the daemon sees it: its folders are shared with the machine's."""
        folder = str(axis.config.recorder.directory)
        _run("install", "-d", "-o", "servod", "-g", "servod", folder)
        _run("mount", "-t", "tmpfs", "-o", f"size={self.kib}k,mode=1777", "none", folder)


class DiskBack(GuestAction):
    """The small disk is taken away again."""

    def act(self, axis: ProcessAxis) -> None:
        """Unmount it, also from under open files."""
        _run("umount", "--lazy", str(axis.config.recorder.directory))


class CanSend(GuestAction):
    """A stranger sends one frame by cansend(1), for example `080#` or `701#00`."""

    frame: str = Field(pattern=r"^[0-9A-F]{3}#[0-9A-F]{0,16}$")

    def loss(self) -> Loss:
        """NMT commands other than start take a node out of operational."""
        return Loss.FEEDBACK if self.frame.startswith("000#") and self.frame[4:6] != "01" else Loss.NONE

    def act(self, axis: ProcessAxis) -> None:
        """Send it."""
        assert isinstance(axis.wire, CanWire)
        _run("cansend", axis.wire.interface, self.frame)


class CanGen(GuestAction):
    """A stranger sends frame after frame by cangen(1)."""

    can_id: str = Field(pattern=r"^[0-9A-F]{3}$")
    length: int = Field(8, ge=0, le=8)
    gap_ms: float = Field(ge=0.0, le=1000.0)
    for_ms: int = Field(ge=100, le=10_000)

    def act(self, axis: ProcessAxis) -> None:
        """Let it run for its time."""
        assert isinstance(axis.wire, CanWire)
        frames = ["-I", self.can_id, "-L", str(self.length), "-g", str(self.gap_ms), "-i"]
        _run("timeout", str(self.for_ms / 1e3), "cangen", axis.wire.interface, *frames)


GUEST_ACTIONS: dict[str, type[Action]] = {
    "interface": Interface,
    "set_clock": SetClock,
    "small_disk": SmallDisk,
    "disk_back": DiskBack,
    "cansend": CanSend,
    "cangen": CanGen,
}
