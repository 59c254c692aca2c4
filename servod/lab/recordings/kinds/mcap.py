"""Reads MCAP: the daemon's own recordings, and ROS 2 bags in which `sensor_msgs/msg/JointState` stands.

Messages of ROS 2 are decoded by Foxglove's mcap-ros2-support alone (extra `ros2`).
"""

from __future__ import annotations

import array
from collections.abc import Callable, Container, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from servod.common.errors import BadInput
from servod.formats.recording.mcap_reader import TIME, foreign_messages, read_recording
from servod.lab.recordings.bounds import FileBounds, by_number

JOINT_STATE = "sensor_msgs/msg/JointState"
_FIELDS = ("position", "velocity", "effort")
_NS_PER_S = 1e9


def read(path: Path, wanted: Container[str], bounds: FileBounds, notes: list[str]) -> dict[str, Any]:
    """Columns of the daemon's cycles; of another file `JOINT.position`, `JOINT.velocity`, `JOINT.effort`, and `t_s`.

    None for those that are not `wanted`. Raises BadInput.
    """
    try:
        recording = read_recording(path, wanted, bounds.most_cells)
    except BadInput as error:
        if "no topic" not in str(error.found) or not (columns := _joint_states(path, wanted, bounds, notes)):
            raise
        return columns
    if recording.damage:
        notes.append(recording.damage)
    cells = np.frombuffer(recording.rows, "<f8").reshape(-1, len(recording.names))
    columns = dict.fromkeys(recording.left_out)
    for at, (name, kind) in enumerate(zip(recording.names, recording.kinds, strict=True)):
        columns[name] = (cells if kind == "d" else cells.view("<i8"))[:, at]
    times_ns = columns[TIME]
    columns["t_s"] = (times_ns - times_ns[:1]) / _NS_PER_S
    return columns


def _joint_states(path: Path, wanted: Container[str], bounds: FileBounds, notes: list[str]) -> dict[str, Any]:
    """The joint states of the first topic that has any; nothing where the file holds none."""
    joints, topic, others = _Joints(wanted, bounds), "", set()
    for schema, channel, message in foreign_messages(path, JOINT_STATE):
        topic = topic or channel.topic
        if channel.topic != topic:
            others.add(channel.topic)
            continue
        decode = _decoder(path, channel.message_encoding, schema)
        try:
            joints.add(decode(message.data), message.log_time)
        except BadInput:
            raise
        except Exception:  # the library says in no way what it raises on a message that is bent
            notes.append(
                f"{topic}: a message that cannot be decoded after {joints.count} rows; what follows is left out"
            )
            break
    if others:
        notes.append(f"joint states on {topic} are read, those on {', '.join(sorted(others)[:6])} are not")
    return joints.columns()


def _decoder(path: Path, encoding: str, schema: Any) -> Callable[[bytes], Any]:
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError:
        raise BadInput(str(path), "joint states of ROS 2", "pip install 'servod[ros2]' to read them") from None
    key = (schema.id, schema.data)
    if key not in _DECODERS:
        _DECODERS.clear()
        try:
            found = DecoderFactory().decoder_for(encoding, schema)
        except Exception:  # as above
            found = None
        if found is None:
            raise BadInput(str(path), f"{schema.name} as {encoding}, {schema.encoding}", "cdr with a ros2msg schema")
        _DECODERS[key] = found
    return _DECODERS[key]


_DECODERS: dict[tuple[int, bytes], Callable[[bytes], Any]] = {}


class _Joints:
    """Rows of joint states, of the joints that are wanted."""

    def __init__(self, wanted: Container[str], bounds: FileBounds) -> None:
        self._wanted, self._bounds = wanted, bounds
        self._names: dict[str, None] = {}
        self._kept: dict[str, array.array[float]] = {}
        self._times_ns: array.array[int] = array.array("q")

    @property
    def count(self) -> int:
        """Rows so far."""
        return len(self._times_ns)

    def add(self, message: Any, log_time_ns: int) -> None:
        """One message; it makes a row where a joint that is wanted stands in it. Raises BadInput."""
        found = {name: value for name, value in self._cells(message) if name in self._wanted}
        self._bounds.require_cells(0, len(self._names))
        if not found:
            return
        for name in {*found, *self._kept}:
            column = self._kept.setdefault(name, array.array("d"))
            column.extend([np.nan] * (self.count - len(column)))
            column.append(found.get(name, np.nan))
        stamp = message.header.stamp
        self._times_ns.append(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or log_time_ns)
        self._bounds.require_cells(self.count, 1 + len(self._kept))

    def _cells(self, message: Any) -> Iterator[tuple[str, float]]:
        for field in _FIELDS:
            values = getattr(message, field)
            for at, value in enumerate(values):
                joint = message.name[at] if at < len(message.name) else by_number(at)
                name = f"{joint}.{field}"
                self._names.setdefault(name)
                yield name, float(value)

    def columns(self) -> dict[str, Any]:
        """All names, those that are wanted with their numbers, and the time since the first row."""
        if not self._names:
            return {}
        times_ns = np.frombuffer(self._times_ns, np.int64) if self.count else np.zeros(0, np.int64)
        kept = {name: np.frombuffer(column, np.float64) for name, column in self._kept.items()}
        return {"t_s": (times_ns - times_ns[:1]) / _NS_PER_S} | {name: kept.get(name) for name in self._names}
