"""Tries from inside the daemon's sandbox what must be allowed and what must not: `probe.py ANSWERS.json`."""

from __future__ import annotations

import json
import os
import socket
import sys
from pathlib import Path

KINDS = {"AF_CAN": (socket.SOCK_RAW, socket.CAN_RAW), "AF_UNIX": (socket.SOCK_STREAM, 0)}
FAMILIES = ("AF_CAN", "AF_UNIX", "AF_INET", "AF_INET6", "AF_NETLINK", "AF_PACKET")
FOLDERS = ("/run/servod", "/var/lib/servod", "/tmp", "/etc/servod", "/usr/local/lib", "/opt", "/root", "/home", "/dev")


def family(name: str) -> str:
    """Whether a socket of this family comes through, or why not."""
    try:
        socket.socket(getattr(socket, name), *KINDS.get(name, (socket.SOCK_RAW, 0))).close()
    except OSError as error:
        return str(error.strerror)
    return "allowed"


def folder(name: str) -> str:
    """Whether a file can be made there, or why not."""
    path = Path(name) / "servod-probe"
    try:
        path.write_text("")
        path.unlink()
    except OSError as error:
        return str(error.strerror)
    return "writable"


def main() -> None:
    """Write what was found."""
    own = dict(line.split(":\t", 1) for line in Path("/proc/self/status").read_text().splitlines() if ":\t" in line)
    answers = {
        "families": {name: family(name) for name in FAMILIES},
        "folders": {name: folder(name) for name in FOLDERS},
        "user": os.getuid(),
        "process": {key: own[key].strip() for key in ("NoNewPrivs", "Seccomp", "CapEff", "CapBnd")},
    }
    Path(sys.argv[1]).write_text(json.dumps(answers))


if __name__ == "__main__":
    main()
