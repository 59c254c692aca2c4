"""The control protocol: one JSON document a line over the daemon's socket, its verbs and its bounds.

Spoken by servod.client.control and served by servod.runtime.daemon.control_server.
"""

from __future__ import annotations

import json
from enum import StrEnum
from typing import Any

#: Longest request; a longer one ends the connection. A gain set with its design and proofs takes 100 KiB.
MAX_LINE_BYTES = 512 * 1024


#: Longest answer that a client takes.
MAX_ANSWER_BYTES = 4 * 1024 * 1024


#: Samples in one request: as text, each takes at most 25 bytes.
PIECE_SAMPLES = 2000

#: Cycle records in one answer: as text, each takes 416 bytes.
PIECE_CYCLES = 500


#: A motion halts when the client that started it has asked nothing for so long, unless that says otherwise [s].
RENEW_S = 0.5
#: The same for tools that measure and compute beside the motion [s].
TOOL_RENEW_S = 1.0


class Verb(StrEnum):
    """What the daemon can be asked."""

    STATUS = "status"
    WATCH = "watch"
    ENABLE = "enable"
    DISABLE = "disable"
    STOP = "stop"
    HALT = "halt"
    TRAJECTORY = "trajectory"
    TRACK = "track"
    GAINS_LOAD = "gains_load"
    GAINS_LIST = "gains_list"
    GAINS_ACTIVATE = "gains_activate"
    GAINS_KEEP = "gains_keep"
    GAINS_ROLLBACK = "gains_rollback"
    RECORD_START = "record_start"
    RECORD_STOP = "record_stop"
    SCAN = "scan"
    FAULTS = "faults"
    CYCLES = "cycles"


#: Verbs that only look; everything else needs the right to command.
READING = frozenset({Verb.STATUS, Verb.WATCH, Verb.GAINS_LIST, Verb.FAULTS, Verb.CYCLES})


class SampleKey(StrEnum):
    """Arguments of `track` that may be long."""

    POSITIONS = "positions_rad"
    TORQUES = "torques_nm"


def encode_line(message: dict[str, Any]) -> bytes:
    """One JSON object as a line; NaN and infinity are refused, JSON has none. Raises ValueError."""
    return json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + b"\n"


def decode_line(line: bytes) -> dict[str, Any]:
    """The JSON object of one line. Raises ValueError when it is anything else."""
    try:
        message = json.loads(line)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(message, dict):
        raise ValueError("not a JSON object")
    return message
