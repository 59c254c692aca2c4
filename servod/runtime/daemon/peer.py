"""Who is at the other end of a Unix socket, as the kernel tells it, and whether they may command the axis.

Below the control server. SO_PEERCRED gives process, user and group (unix(7)); SO_PEERGROUPS the further groups.
"""

from __future__ import annotations

import array
import grp
import os
import socket
import struct
from typing import NamedTuple

_SO_PEERGROUPS = 59  # asm-generic/socket.h; Python has no name for it
_UCRED = struct.Struct("iII")
_GROUPS_BYTES = 1024  # the most that Python's getsockopt takes: 256 groups


class Peer(NamedTuple):
    """The process that opened the connection; `groups` holds its group and its further groups."""

    pid: int
    uid: int
    groups: frozenset[int]


def peer_of(connection: socket.socket) -> Peer:
    """The credentials at the time of connect(2), which the peer cannot forge."""
    pid, uid, gid = _UCRED.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
    return Peer(pid, uid, frozenset({gid, *_further_groups(connection)}))


def _further_groups(connection: socket.socket) -> list[int]:
    try:
        data = connection.getsockopt(socket.SOL_SOCKET, _SO_PEERGROUPS, _GROUPS_BYTES)
    except OSError:
        return []  # a kernel before 4.13, or more groups than fit: the first group still counts
    return list(array.array("I", data[: len(data) // 4 * 4]))


def group_id(name: str) -> int | None:
    """The number of the group `name`; None where this machine has no such group."""
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        return None


def may_command(peer: Peer, group: int | None) -> bool:
    """Root and the daemon's own user always may; others when they are in the configured group."""
    return peer.uid in (0, os.geteuid()) or (group is not None and group in peer.groups)
