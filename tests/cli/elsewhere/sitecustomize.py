"""Lets servod believe that it runs on Windows or macOS: what these lack is not there for it, in all its processes.

Python runs this file at its start when the folder is on PYTHONPATH, so that worker processes have it too;
SERVOD_ELSEWHERE names the platform. Only modules of servod see it, since libraries have their own code for each system.
What Windows or macOS does not have is what Python's own documentation lists as unavailable there.
"""

from __future__ import annotations

import builtins
import importlib
import os
import types
from pathlib import Path
from typing import Any

PLATFORM = os.environ.get("SERVOD_ELSEWHERE", "")

_UNIX_MODULES = {"fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "posix", "_posixsubprocess"}
#: Of Linux alone, and nothing that macOS has.
_LINUX = {
    "os": {
        "sched_getaffinity",
        "sched_setaffinity",
        "sched_setscheduler",
        "sched_getscheduler",
        "sched_param",
        "SCHED_FIFO",
    }
    | {"memfd_create", "eventfd", "posix_fadvise", "getresuid", "getresgid", "pidfd_open", "O_DIRECT", "O_PATH"},
    "socket": {"AF_CAN", "CAN_RAW", "SOCK_CLOEXEC", "SOCK_NONBLOCK", "SO_PEERCRED", "SO_BINDTODEVICE", "AF_NETLINK"},
    "signal": {"SIGRTMIN", "SIGRTMAX", "sigtimedwait", "sigwaitinfo", "pidfd_send_signal"},
    "select": {"epoll"},
    "time": {"CLOCK_BOOTTIME", "CLOCK_TAI"},
}
#: Of every Unix, and not of Windows.
_UNIX = {
    "os": {
        "getuid",
        "geteuid",
        "getgid",
        "getegid",
        "getgroups",
        "fork",
        "forkpty",
        "setsid",
        "getpgid",
        "setpgid",
        "killpg",
    }
    | {
        "uname",
        "statvfs",
        "mkfifo",
        "fchmod",
        "fchown",
        "chown",
        "lchown",
        "chroot",
        "nice",
        "getpriority",
        "getloadavg",
    }
    | {"O_CLOEXEC", "O_NONBLOCK", "O_DIRECTORY", "O_NOFOLLOW", "O_SYNC", "pread", "pwrite", "sysconf", "wait", "wait3"}
    | {"WIFEXITED", "WEXITSTATUS", "register_at_fork", "sched_yield", "openpty", "ttyname", "pipe2", "initgroups"},
    "socket": {"AF_UNIX", "SO_REUSEPORT", "socketpair", "sethostname"},
    "signal": {
        "SIGHUP",
        "SIGQUIT",
        "SIGKILL",
        "SIGSTOP",
        "SIGCONT",
        "SIGUSR1",
        "SIGUSR2",
        "SIGPIPE",
        "SIGALRM",
        "SIGCHLD",
    }
    | {"pthread_sigmask", "pthread_kill", "alarm", "setitimer", "sigwait", "SIG_BLOCK", "SIG_UNBLOCK", "pause"},
    "select": {"poll"},
    "time": {"clock_gettime", "clock_gettime_ns", "CLOCK_MONOTONIC", "CLOCK_REALTIME", "pthread_getcpuclockid"},
    "mmap": {"MAP_SHARED", "MAP_PRIVATE", "PROT_READ", "PROT_WRITE"},
}
_WINDOWS_SIGNALS = ("SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM")
_MISSING = {
    name: _LINUX.get(name, set()) | (_UNIX.get(name, set()) if PLATFORM == "win32" else set())
    for name in {*_LINUX, *_UNIX}
}


class _Seen(types.ModuleType):
    """A module as servod sees it there."""

    def __init__(self, real: types.ModuleType, missing: set[str], **instead: Any) -> None:
        super().__init__(real.__name__)
        self.__dict__.update(_real=real, _missing=missing, **instead)

    def __getattr__(self, name: str) -> Any:
        if name in self.__dict__["_missing"]:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r} on {PLATFORM}")
        return getattr(self.__dict__["_real"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.__dict__["_real"], name, value)


def _refuse_folder(path: Any, flags: int, *rest: Any, **named: Any) -> int:
    """os.open: Windows opens no folder, and removes a file with O_TEMPORARY at its close (here at once)."""
    if Path(path).is_dir():
        raise PermissionError(13, "Permission denied", str(path))
    descriptor = os.open(path, flags & ~(_O_TEMPORARY | _O_BINARY), *rest, **named)
    if flags & _O_TEMPORARY:
        _temporary.append((descriptor, path))
    return descriptor


def _close(descriptor: int) -> None:
    os.close(descriptor)
    for entry in [e for e in _temporary if e[0] == descriptor]:
        _temporary.remove(entry)
        Path(entry[1]).unlink(missing_ok=True)  # with the last that is closed, there


def _library(name: str | None, *rest: Any, **named: Any) -> Any:
    """ctypes.CDLL: Windows knows none without a name, and the C library of macOS has no prctl(2)."""
    if PLATFORM == "win32" and name is None:
        raise TypeError("argument 1 must be str, not None")
    library = importlib.import_module("ctypes").CDLL(name, *rest, **named)
    library.prctl = None  # calling it fails
    return library


def _locking(descriptor: int, mode: int, count: int) -> None:
    """msvcrt.locking by lockf(3)."""
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise PermissionError(13, "Permission denied") from None


_O_TEMPORARY, _O_BINARY = 1 << 28, 1 << 29
_temporary: list[tuple[int, Any]] = []
_seen: dict[str, types.ModuleType] = {}


def _as_there(name: str) -> types.ModuleType:
    if name not in _seen:
        real, instead = importlib.import_module(name), {}
        if name == "sys":
            instead = {"platform": PLATFORM}
        elif name == "ctypes":
            instead = {"CDLL": _library}
        elif name == "os" and PLATFORM == "win32":
            windows = {"O_TEMPORARY": _O_TEMPORARY, "O_BINARY": _O_BINARY, "open": _refuse_folder, "close": _close}
            instead = {**windows, "name": "nt"}
        elif name == "signal" and PLATFORM == "win32":
            instead = {"Signals": [getattr(real, signal) for signal in _WINDOWS_SIGNALS]}
        _seen[name] = _Seen(real, _MISSING.get(name, set()), **instead)
    return _seen[name]


_import = builtins.__import__


def _import_there(
    name: str,
    globals: Any = None,
    locals: Any = None,
    fromlist: Any = (),
    level: int = 0,
) -> types.ModuleType:
    if level or not str((globals or {}).get("__name__", "")).startswith("servod"):
        return _import(name, globals, locals, fromlist, level)
    if name == "msvcrt" and PLATFORM == "win32":
        found = types.ModuleType("msvcrt")
        found.__dict__.update(locking=_locking, LK_LOCK=1, LK_NBLCK=2)
        return found
    if PLATFORM == "win32" and name.partition(".")[0] in _UNIX_MODULES:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    if name in (*_MISSING, "sys", "ctypes"):
        return _as_there(name)
    return _import(name, globals, locals, fromlist, level)


if PLATFORM:
    builtins.__import__ = _import_there
