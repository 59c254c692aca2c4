"""A whole Linux in one process (user-mode-linux): real SocketCAN and real systemd where the host has neither.

    python -m tests.guest.guest [STEP ...]      build the image if need be, run inside, print the results as JSON lines

Needs: apt-get install user-mode-linux mmdebstrap e2fsprogs gcc; root, and the network once.
The image (Debian with systemd, and what servod needs of PyPI) is kept in ~/.cache/servod-guest; servod itself comes
fresh with each run through a shared folder. One slow CPU: behaviour is tested there, never timing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tests.guest.host import told

REPOSITORY = Path(__file__).resolve().parents[2]
CACHE = Path(os.environ.get("SERVOD_GUEST_CACHE", Path.home() / ".cache" / "servod-guest"))
PACKAGES = "systemd,systemd-sysv,dbus,python3,iproute2,kmod,procps,can-utils"
GUEST_PYTHON = "3.11"  # Debian bookworm's
BOOT_TIMEOUT_S = 800
#: Other people's CANopen devices, for the step `foreign`; without their sources the guest goes without them.
THIRD_PARTY = REPOSITORY.parent / "shared" / "third_party"
#: In which the work of tests/guest/inside/power.py has come round.
CUT_WITHIN_S = 12.0

#: Runs at the end of the boot; the shared folder's path on the host stands on the kernel's command line.
_TESTS_UNIT = """\
[Unit]
Description=servod tests
[Service]
Type=oneshot
TimeoutStartSec=infinity
ExecStart=/bin/sh -c 'mount -t hostfs none /mnt -o "$(sed "s/.*servod.share=//; s/ .*//" /proc/cmdline)"'
ExecStart=/bin/sh -c 'cd /mnt && exec /usr/bin/python3 -m inside /mnt $(cat steps)'
ExecStopPost=/bin/systemctl --no-block poweroff
StandardOutput=journal+console
"""


def dependencies() -> list[str]:
    """What the plain install of servod needs, numpy for its models, and what its tests need.

    No numba: there its start costs minutes, and the plant in plain Python a twentieth of the guest's time.
    """
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"]
    more = ("numpy", "pytest>", "hypothesis")
    return [*project["dependencies"], *(d for d in (*optional["lab"], *optional["dev"]) if d.startswith(more))]


def image() -> Path:
    """The guest's disk, built when it is missing or the dependencies changed."""
    key = hashlib.sha256(json.dumps([PACKAGES, GUEST_PYTHON, _TESTS_UNIT, dependencies()]).encode()).hexdigest()[:16]
    path = CACHE / f"root-{key}.ext4"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=CACHE, prefix="build-") as folder:
            _build(Path(folder) / "root", path)
    return path


def _build(root: Path, path: Path) -> None:
    command = ["mmdebstrap", "--quiet", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(root)]
    subprocess.run(command, check=True)
    site = root / "usr/local/lib/python3.11/dist-packages"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-compile", "--only-binary=:all:"]
    command += ["--target", str(site)]
    subprocess.run([*command, "--python-version", GUEST_PYTHON, *dependencies()], check=True)
    inside = f"/{site.relative_to(root)}"  # by the guest's Python, whose users may not write there
    subprocess.run(["chroot", str(root), "python3", "-m", "compileall", "-q", inside], check=True)
    shutil.copytree("/usr/lib/uml/modules", root / "lib/modules", dirs_exist_ok=True)
    system = root / "etc/systemd/system"
    for getty in ("serial-getty@ttyS0", "getty@tty1", "console-getty"):
        (system / f"{getty}.service").symlink_to("/dev/null")
    (system / "servod-tests.service").write_text(_TESTS_UNIT)
    wants = system / "multi-user.target.wants"
    wants.mkdir(exist_ok=True)
    (wants / "servod-tests.service").symlink_to("../servod-tests.service")
    aside = path.with_suffix(".part")
    subprocess.run(["mke2fs", "-q", "-F", "-t", "ext4", "-d", str(root), "-L", "root", str(aside), "900M"], check=True)
    aside.replace(path)


def _share(folder: Path) -> None:
    """Everything of this run that the guest needs: servod as installed from its wheel, units, and the steps."""
    wheels = folder / "wheels"
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(wheels), str(REPOSITORY)]
    subprocess.run(command, check=True)
    (wheel,) = wheels.glob("servod-*.whl")
    shutil.unpack_archive(wheel, folder / "site", "zip")
    for name in ("systemd", "gains", "tests/conformance"):
        shutil.copytree(REPOSITORY / name, folder / name)
    shutil.copytree(Path(__file__).with_name("inside"), folder / "inside")
    if THIRD_PARTY.is_dir():
        build = "from tests.foreign.canopennode import *; build(Path(sys.argv[1]), '-static')"
        command = [sys.executable, "-c", f"import sys; {build}", str(folder / "canopennode")]
        subprocess.run(command, check=True, cwd=REPOSITORY)


def run(steps: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Boot, run tests/guest/inside (all of it, or the steps with these names), and give its results.

    Raises RuntimeError when the guest gives none.
    """
    disk = image()
    with tempfile.TemporaryDirectory(prefix="servod-guest-") as name:
        folder = Path(name)
        _share(folder)
        (folder / "steps").write_text(" ".join(steps))
        console = _boot(disk, folder)
        results = folder / "results.jsonl"
        if not results.exists():
            raise RuntimeError(f"the guest gave no results; its console ended with:\n{console[-4000:]}")
        return [json.loads(line) for line in results.read_text().splitlines()]


def cut(count: int, rng: random.Random) -> list[dict[str, Any]]:
    """Cut the machine's power `count` times, each at a random moment of its work; what each next start found."""
    disk = image()
    with tempfile.TemporaryDirectory(prefix="servod-guest-") as name:
        folder = Path(name)
        _share(folder)
        told = folder / "told.jsonl"
        for begun in range(count):
            (folder / "steps").write_text("powered" if begun else "install powered")
            with _booted(disk, folder) as guest:
                deadline = time.monotonic() + BOOT_TIMEOUT_S
                while not told.exists() or told.read_text().count('"boot"') <= begun:
                    if guest.poll() is not None or time.monotonic() > deadline:
                        raise RuntimeError(f"start {begun}: {(folder / 'results.jsonl').read_text()}")
                    time.sleep(0.05)
                time.sleep(rng.uniform(0.0, CUT_WITHIN_S))
        (folder / "last").touch()
        (folder / "steps").write_text("powered")
        _boot(disk, folder)
        results = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
        if "cuts" not in results[-1]:
            raise RuntimeError(results[-1]["error"])
        return list(results[-1]["cuts"])[1:]


@contextlib.contextmanager
def _booted(disk: Path, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A guest that is killed, all of it at once, at the end of the block: what its kernel had not written is lost."""
    with (folder / "console").open("wb") as console:
        guest = subprocess.Popen(
            _command(disk, folder),
            stdin=subprocess.DEVNULL,
            stdout=console,
            stderr=subprocess.STDOUT,
            env=_environment(),
            start_new_session=True,
        )
        try:
            yield guest
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(guest.pid, signal.SIGKILL)
            guest.wait()


def _shim() -> Path:
    """The library that whole_xstate.c explains."""
    path = CACHE / "whole_xstate.so"
    source = Path(__file__).with_name("whole_xstate.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-o", str(path), str(source)], check=True)
    return path


def _command(disk: Path, folder: Path) -> list[str]:
    """One pinned CPU; the disk's changes beside it, in the folder of this run."""
    return [
        *("taskset", "-c", str(min(os.sched_getaffinity(0))), "linux.uml", "mem=768M"),
        *(f"ubd0={folder / 'root.cow'},{disk}", "root=/dev/ubda", "rootfstype=ext4", "rw", "init=/sbin/init"),
        *("con=null", "con0=fd:0,fd:1", "quiet", f"servod.share={folder}"),
    ]


def _environment() -> dict[str, str]:
    return {**os.environ, "LD_PRELOAD": str(_shim())}


def _boot(disk: Path, folder: Path) -> str:
    """Run the guest to its end; returns what its console said. Raises RuntimeError with what it did when it hangs."""
    with _booted(disk, folder) as guest:
        with told(guest.pid, folder / "starved"), contextlib.suppress(subprocess.TimeoutExpired):
            guest.wait(BOOT_TIMEOUT_S)
        hangs = guest.poll() is None
    console = (folder / "console").read_text(errors="replace")
    if hangs:
        results = folder / "results.jsonl"
        done = [json.loads(line)["step"] for line in results.read_text().splitlines()] if results.exists() else []
        raise RuntimeError(
            f"not done after {BOOT_TIMEOUT_S} s, behind {done}; its console ended with:\n{console[-2000:]}"
        )
    return console


if __name__ == "__main__":
    for result in run(sys.argv[1:]):
        print(json.dumps(result))
