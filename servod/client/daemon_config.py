"""The configuration that a running daemon has, for clients whose answer depends on its scales and limits.

Beside servod.client.control. The daemon attaches its file to every recording; a recording of a moment tells it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from servod.client.control import ControlClient, Verb
from servod.common.errors import BadInput, Unreachable
from servod.common.yaml import parse_yaml, validate
from servod.formats.config import AxisConfig
from servod.formats.recording.mcap_reader import read_recording

#: What of a configuration decides how an axis measures and moves.
_OF_THE_AXIS = frozenset({"name", "cycle", "amplifier", "encoder", "limits"})
#: Paths: `load_config` has made them absolute, the daemon's text has not.
_PATHS = frozenset({"amplifier.eds", "encoder.eds"})


def daemon_config(client: ControlClient) -> AxisConfig:
    """The daemon's configuration; relative paths stay as they stand in its file. Raises Unreachable."""
    path = Path(client.call(Verb.RECORD_START)["path"])
    client.call(Verb.RECORD_STOP)
    attached = read_recording(path).attachments.get("config.yaml")
    if attached is None:
        raise Unreachable(f"{path}: the daemon attached no configuration")
    with contextlib.suppress(OSError):  # it may be the daemon's alone
        path.unlink()
    return validate(parse_yaml(attached.decode(), str(path)), AxisConfig, str(path))


def require_daemon_config(client: ControlClient, config: AxisConfig) -> None:
    """Refuse a configuration that describes another axis than the daemon's. Raises BadInput, naming the first key."""
    runs = dict(_values(daemon_config(client).model_dump(mode="json", include=set(_OF_THE_AXIS))))
    for key, value in _values(config.model_dump(mode="json", include=set(_OF_THE_AXIS))):
        if key not in _PATHS and value != runs[key]:
            raise BadInput(f"--config: {key}", value, f"{runs[key]}, as the daemon runs with")


def _values(section: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of nested mappings with its dots, and its value."""
    for key, value in section.items():
        if isinstance(value, dict):
            yield from _values(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
