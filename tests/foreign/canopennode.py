"""CANopenNode, another people's CANopen stack, built from the tarballs beside the project and put on the virtual bus.

Nothing of it is copied into the project: it is unpacked and compiled in a temporary folder, as it is, with what stands
in `c/` beside it (the library that gives it the virtual bus, and the applications of an encoder and an amplifier).
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.starved import LOGS

HERE = Path(__file__).resolve().parent
THIRD_PARTY = HERE.parents[2] / "shared" / "third_party"
TARBALLS = tuple(THIRD_PARTY / f"{name}.tar.gz" for name in ("CANopenLinux", "CANopenNode"))

#: As the stack's own `make`: in one thread. Without storage: a device that finds no file of its own reports an error.
_FLAGS = ("-O1", "-w", "-DCO_SINGLE_THREAD", "-DCO_CONFIG_STORAGE=0")
#: A device looks at its application each millisecond.
_DEVICE = ("-DCO_USE_APPLICATION", "-DMAIN_THREAD_INTERVAL_US=1000")
_START_S = 10.0


def missing() -> str:
    """Why CANopenNode cannot be built here; empty when it can."""
    if absent := [path.name for path in TARBALLS if not path.is_file()]:
        return f"no {' and '.join(absent)} in {THIRD_PARTY}"
    return "" if shutil.which("cc") else "no C compiler"


def build(folder: Path, *link: str) -> Path:
    """Everything built in `folder`, once for all workers of a test run; `link` are further words for the linker."""
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "built").exists():
            _build(folder, link)
            (folder / "built").touch()
    return folder


def _build(folder: Path, link: Sequence[str]) -> None:
    for tarball in TARBALLS:
        shutil.unpack_archive(tarball, folder)
    linux, stack = folder / "CANopenLinux", folder / "CANopenNode"
    _run("cc", "-O1", "-Wall", "-Werror", "-shared", "-fPIC", "-o", folder / "bus.so", HERE / "c/can_over_unix.c")
    made = (linux / "Makefile").read_text()
    sources = [
        Path(name.replace("$(DRV_SRC)", str(linux)).replace("$(CANOPEN_SRC)", str(stack)))
        for name in re.findall(r"^\t(\$\((?:DRV|CANOPEN)_SRC\)/\S+\.c)", made, re.MULTILINE)
    ]
    include = [f"-I{place}" for place in (linux, stack, stack / "example")]
    main = linux / "CO_main_basic.c"
    _run("cc", *_FLAGS, *include, "-c", *(source for source in sources if source != main), cwd=folder)
    objects = sorted(folder.glob("*.o"))
    dictionary = (stack / "example/OD.c").read_text()
    _run("cc", "-o", folder / "canopend", *objects, *_FLAGS, *include, stack / "example/OD.c", main, *link)
    for name in ("encoder", "amplifier"):
        (folder / f"{name}_OD.c").write_text(_with_objects(dictionary))
        mine = [f"{name}_OD.c", HERE / f"c/{name}.c", f"-I{HERE / 'c'}", f'-DAPPLICATION="{name}.h"', *_DEVICE]
        _run("cc", "-o", folder / name, *objects, *_FLAGS, *include, *mine, main, "-lm", *link, cwd=folder)


def _with_objects(dictionary: str) -> str:
    """The stack's example of a dictionary, which has the objects of CiA 301, with those of a profile behind them."""
    parts = re.fullmatch(r"(.*\n)(static \S+ OD_entry_t ODList\[\] = \{\n.*)(    \{0x0000,.*)", dictionary, re.DOTALL)
    assert parts is not None, "another form of OD.c"
    return f'{parts[1]}#include "objects.h"\n{parts[2]}    APPLICATION_ENTRIES\n{parts[3]}'


def _run(*command: str | Path, cwd: Path | None = None) -> None:
    done = subprocess.run([str(word) for word in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, f"{command[0]}: {done.stderr}"


class Party:
    """A program of CANopenNode on the bus; what it said of itself is in `log`."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path, console: socket.socket) -> None:
        self.process, self._log, self.console = process, log, console

    @property
    def log(self) -> str:
        """Its messages so far."""
        return self._log.read_text(errors="replace")

    def wait_for(self, said: str, times: int = 1, timeout_s: float = 5.0) -> None:
        """Wait until its log has `said`, so many times."""
        deadline = time.monotonic() + timeout_s
        while self.log.count(said) < times:
            assert time.monotonic() < deadline, f"it never said {said!r}:\n{self.log[-2000:]}"
            time.sleep(0.01)


@contextmanager
def party(
    built: Path, name: str, bus: Path, node_id: int, folder: Path, more: Sequence[str] = (), joint: Path | None = None
) -> Iterator[Party]:
    """Run one of the programs as node `node_id` for the time of a `with` block, its files in `folder`."""
    log = folder / f"{name}-{node_id}.log"
    LOGS.append(log)
    environment = {**os.environ, "VIRTUAL_CAN": str(bus), "LD_PRELOAD": str(built / "bus.so"), "JOINT": str(joint)}
    ours, theirs = socket.socketpair()  # its console: canopend answers on its standard input
    with ours, theirs, log.open("w") as said:
        ours.settimeout(_START_S)
        command = [built / name, "virtual", "-i", str(node_id), *more]
        process = subprocess.Popen(command, stdin=theirs, stdout=said, stderr=said, env=environment)
        try:
            running = Party(process, log, ours)
            running.wait_for("running ...", timeout_s=_START_S)
            yield running
        finally:
            process.kill()
            process.wait()


class Refused(Exception):
    """The answer of the gateway, CiA 309-3: an abort code of SDO or an error of its own."""

    def __init__(self, code: int) -> None:
        self.code = code
        super().__init__(f"0x{code:08X}" if code > 999 else str(code))


class Gateway:
    """The commands of CiA 309-3 that `canopend` takes: its SDO client, NMT master and LSS master."""

    def __init__(self, canopend: Party) -> None:
        self.party = canopend
        self._number = 0

    def ask(self, command: str) -> str:
        """One command; its answer, raises Refused."""
        self._number += 1
        console, answer = self.party.console, b""
        console.sendall(f"[{self._number}] {command}\r\n".encode())
        while not answer.endswith(b"\n"):
            answer += console.recv(4096)
        said = answer.decode().removeprefix(f"[{self._number}] ").strip()
        if found := re.match(r"ERROR: ?(?:0x([0-9A-F]{8})|(\d+))", said):
            raise Refused(int(found[1], 16) if found[1] else int(found[2]))
        return said

    def read(self, node_id: int, index: int, subindex: int, kind: str) -> str:
        """SDO upload; `kind` is a data type of CiA 309-3."""
        return self.ask(f"{node_id} r 0x{index:04X} {subindex} {kind}")

    def write(self, node_id: int, index: int, subindex: int, kind: str, value: object) -> None:
        """SDO download."""
        answer = self.ask(f"{node_id} w 0x{index:04X} {subindex} {kind} {value}")
        assert answer == "OK"

    def refusal(self, command: str) -> int:
        """The code with which a command is refused."""
        try:
            answer = self.ask(command)
        except Refused as refused:
            return refused.code
        raise AssertionError(f"{command}: {answer}")
