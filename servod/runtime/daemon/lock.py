"""One daemon per control socket and per bus: locked files that give their locks back with their process.

Taken by the supervisor before it touches either, and by whoever else wants the bus for itself. The lock of a control
socket or of a virtual bus lies beside its socket, that of every other bus in the runtime folder, with the network name
space in its name that the interface lives in: one place for each interface, whoever starts a daemon. Owner and group
alone may open such a file, so that nobody else on the machine keeps a daemon from its start; names that anybody may
bind, as the abstract ones of sockets, would let them.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import pwd
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import quote

from servod.common.errors import Unreachable
from servod.common.files import reason
from servod.formats.config import AxisConfig, BusConfig

#: Of the service (RuntimeDirectory=). Two places would let two daemons on one bus.
RUNTIME_FOLDER = Path("/run/servod")
_OPEN = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_RIGHTS = 0o660
_PID_BYTES = 20
#: Commands that may come and go, and take the file away with them, between its opening and its lock.
_TRIES = 100


class _Lock:
    """Locks of one process; `release`, the end of a `with` block or of the process gives them back.

    The files stay, and `keep` makes one again that somebody else took away. Those of a command that comes and goes are
    taken away by itself while it still holds them, where there was none before; their folders stay, for others may have
    come to rely on them.
    """

    def __init__(self, *wanted: tuple[str, Path], passing: bool = False) -> None:
        """What is owned, and its file; `passing`: of a command that comes and goes.

        Raises Unreachable, with who stands in the way, when one cannot be had.
        """
        self._files: dict[tuple[str, Path], int] = {}
        self._made = set[Path]()
        try:
            for what, path in wanted:
                self._files[what, path], made = _taken(what, path)
                if passing and made:
                    self._made.add(path)
        except Unreachable:
            self.release()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.release()

    def keep(self) -> None:
        """Make the files again that somebody removed, before another takes them. Raises Unreachable: one has."""
        for (what, path), file in self._files.items():
            if not _is_at(path, file):
                self._files[what, path], _ = _taken(what, path)
                os.close(file)

    def release(self) -> None:
        """Give the locks back."""
        while self._files:
            (_, path), file = self._files.popitem()
            if path in self._made and _is_at(path, file):
                with contextlib.suppress(OSError):
                    path.unlink()
            os.close(file)


class InstanceLock(_Lock):
    """What a daemon owns: its control socket and its bus."""

    def __init__(self, config: AxisConfig, passing: bool = False) -> None:
        socket = config.control.socket.resolve()
        super().__init__((f"control socket {socket}", _beside(socket)), _of_bus(config.bus), passing=passing)


class BusLock(_Lock):
    """The bus alone, for a program that uses it for a moment."""

    def __init__(self, bus: BusConfig) -> None:
        super().__init__(_of_bus(bus), passing=True)


def _taken(what: str, path: Path) -> tuple[int, bool]:
    """The file, locked for this process, and whether it was made for that. Raises Unreachable."""
    for _ in range(_TRIES):
        file, made = _locked(what, path)
        if _is_at(path, file):
            break
        os.close(file)  # who had it until now has taken the file away
    else:
        raise Unreachable(f"{what}: its lock {path} is taken away again and again")
    with contextlib.suppress(OSError):  # a full disk: it is ours all the same, only nobody can tell whose
        os.pwrite(file, f"{os.getpid()}\n".ljust(_PID_BYTES).encode(), 0)
    return file, made


def _locked(what: str, path: Path) -> tuple[int, bool]:
    """A file that stood at `path`, locked for this process, and whether it was made. Raises Unreachable."""
    try:
        file, made = _open(path)
    except OSError as error:
        owner = f", which belongs to user {_owner(path)}" if os.path.lexists(path) else ""
        raise Unreachable(f"{what}: its lock {path}{owner}, cannot be opened ({reason(error)})") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        holder = os.pread(file, _PID_BYTES, 0).decode(errors="replace").strip() or "unknown"
        os.close(file)
        raise Unreachable(f"{what}: another servod (process {holder}) owns it") from None
    return file, made


def _is_at(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(file))
    except OSError:
        return False


def _of_bus(bus: BusConfig) -> tuple[str, Path]:
    what = f"bus {bus.interface} {bus.channel}"
    if bus.interface == "virtual":
        return what, _beside(Path(bus.channel).resolve())
    space = Path("/proc/self/ns/net").stat().st_ino
    name = f"bus-{bus.interface}-{quote(bus.channel, safe='')}-{space}.lock"
    return what, _runtime_folder(what, name, bus.interface == "socketcan") / name


def _beside(socket: Path) -> Path:
    return socket.with_name(f"{socket.name}.lock")


def _runtime_folder(what: str, name: str, shared: bool) -> Path:
    """Where the lock `name` is, or may be made by this user. Raises Unreachable when there is no such folder.

    An interface of the kernel is `shared` by all users of the machine, and so is the one place of its lock. An adapter
    is its user's alone.
    """
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    if os.access(RUNTIME_FOLDER, os.W_OK | os.X_OK) or os.path.lexists(RUNTIME_FOLDER / name):
        return RUNTIME_FOLDER
    if own.startswith("/") and not shared:
        return Path(own)
    if os.geteuid() == 0:
        return RUNTIME_FOLDER
    raise Unreachable(
        f"{what}: no lock for it, for nothing may be written in {RUNTIME_FOLDER}; run as the user servod, or where "
        f'the service is not installed: sudo install -d -o "$USER" {RUNTIME_FOLDER}'
    )


def _open(path: Path) -> tuple[int, bool]:
    """The file, and whether it was made: for the folder's owner when root makes it, who is not to lock him out."""
    with contextlib.suppress(FileNotFoundError):
        return os.open(path, _OPEN), False
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = os.open(path, _OPEN | os.O_CREAT | os.O_EXCL, _RIGHTS)
    except FileExistsError:  # another has made it meanwhile, and may have taken it away again
        return _open(path)
    os.fchmod(file, _RIGHTS)  # whatever the umask left of them
    if os.geteuid() == 0:
        folder = path.parent.stat()
        os.fchown(file, folder.st_uid, folder.st_gid)
    return file, True


def _owner(path: Path) -> str:
    number = path.lstat().st_uid
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)
