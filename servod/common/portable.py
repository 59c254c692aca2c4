"""What Linux, macOS and Windows do each in their own way: locks, cores, folders on disk, workers that outlive nobody.

Ground floor. Daemon and loop run on Linux alone; whatever works on files runs on a laptop too, and asks here.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import IO, Any

from servod.common.errors import Unreachable

#: Whether this is where a daemon can run: Unix sockets that tell the peer, SocketCAN, real-time scheduling.
ON_LINUX = sys.platform == "linux"
_NAMES = {"win32": "Windows", "darwin": "macOS"}
_LOCK_NAME = ".servod.lock"


def need_linux(what: str) -> None:
    """See that `what` can be done on this system. Raises Unreachable."""
    if not ON_LINUX:
        system = _NAMES.get(sys.platform, sys.platform)
        raise Unreachable(f"{what} needs Linux, where servod runs; this is {system}, which works on files alone")


def usable_cores() -> int:
    """Cores that this process may use; those of the machine where the system does not tell."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def lock_file(file: IO[Any], wait: bool) -> None:
    """Lock an open file until it is closed or the process ends. Raises OSError when another has it, unless `wait`."""
    _lock(file.fileno(), wait)


def lock_folder(folder: Path) -> int:
    """Lock a folder until the descriptor that this returns is closed, or the process ends.

    No file is left behind: Windows, which cannot lock a folder, gets one that goes with its descriptor. Raises OSError
    when another has it.
    """
    if sys.platform == "win32":
        flags = os.O_RDWR | os.O_CREAT | os.O_TEMPORARY
        descriptor = os.open(folder / _LOCK_NAME, flags)
    else:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        _lock(descriptor, wait=False)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def lock_again(descriptor: int) -> int:
    """The same lock by a descriptor that was handed to this process; it, too. Raises OSError when another has it."""
    _lock(descriptor, wait=False)
    return descriptor


def is_locked(descriptor: int) -> bool:
    """Whether another holds the lock of this open file; two who ask at once do not take one another for it."""
    try:
        if sys.platform == "win32":
            _lock(descriptor, wait=False)
        else:
            import fcntl

            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    return False


def _lock(descriptor: int, wait: bool) -> None:
    if sys.platform == "win32":
        import msvcrt

        while True:
            try:
                msvcrt.locking(descriptor, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)  # LK_LOCK: for ten seconds
                return
            except OSError:
                if not wait:
                    raise
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def flush_folder(folder: Path) -> None:
    """Have the names in `folder` on the disk, as after a rename; Windows keeps them without being asked."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def has_group(name: str) -> bool:
    """Whether this machine has the group `name`; a system without groups has none."""
    try:
        import grp
    except ImportError:
        return False
    try:
        grp.getgrnam(name)
    except KeyError:
        return False
    return True


def end_with_parent(parent: int) -> None:
    """Have this worker process end when `parent`, which started it, has gone in whatever way."""
    if sys.platform == "linux":
        import ctypes
        import signal

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it died before we asked
            os._exit(1)
    else:
        import threading

        threading.Thread(target=_wait_for_parent, daemon=True).start()


_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def _wait_for_parent() -> None:
    from multiprocessing import parent_process

    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
