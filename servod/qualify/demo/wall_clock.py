"""The demo on the wall clock: daemon and virtual axis as their own processes, commanded over the control socket.

Beside the data path; a client like `servoctl`. The virtual axis is the only one that knows the plant.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from servod.client.control import ControlClient
from servod.client.processes import running_axis, sigterm_as_interrupt, socket_folder
from servod.common.errors import AnswerIsNo
from servod.common.faults import FaultCode
from servod.formats.protocol import TOOL_RENEW_S
from servod.formats.recording.mcap_reader import read_recording
from servod.qualify.demo.axis import demo_config
from servod.qualify.demo.entries import DemoRow
from servod.qualify.demo.runs import Run, cut_motion

#: Told how far a run is: controller and share from 0 to 1.
Progress = Callable[[str, float], None]

_POLL_S = 0.1
_HOME_S = 2.0


class WallRuns(NamedTuple):
    """The runs, and what of the loop's real-time rights the system refused, with the reason."""

    runs: list[Run]
    refused: list[str]


def run_wall(plant: Path, duration_s: float, rows: Sequence[DemoRow], recordings: Path, progress: Progress) -> WallRuns:
    """Track trajectory (19) for `duration_s` under each entry; one recording each stays in `recordings`, which exists.

    Raises AnswerIsNo when the axis does not get through, Unreachable when a process does not start.
    """
    with sigterm_as_interrupt(), socket_folder("servod-demo-") as name:
        folder = Path(name)
        with running_axis(demo_config(folder, recordings), plant, folder) as (client, _):
            client.call("enable")
            status = client.call("status")
            home_rad = float(status["motion"]["reference_rad"])
            runs = []
            for row in rows:
                runs.append(_run(client, row, duration_s, recordings, progress))
                _go_home(client, home_rad)
            client.call("disable")
    return WallRuns(runs, [f"{g['name']} ({g['reason']})" for g in status["grants"] if not g["granted"]])


def _run(client: ControlClient, row: DemoRow, duration_s: float, recordings: Path, progress: Progress) -> Run:
    """One entry: activate it, record trajectory (19), and cut the motion from the recording."""
    activate(client, row.gains)
    (recordings / f"{row.name}.mcap").unlink(missing_ok=True)
    path = client.call("record_start", path=f"{row.name}.mcap")["path"]
    started = time.monotonic()
    client.call("track", kind="paper", duration_s=duration_s, renew_s=TOOL_RENEW_S)
    while _moves(client):
        progress(row.name, min(1.0, (time.monotonic() - started) / duration_s))
    progress(row.name, 1.0)
    client.call("record_stop")
    return cut_motion(row.name, read_recording(path).rows)


def activate(client: ControlClient, gains: Path) -> None:
    """Load a gain-set file into the daemon and change to it."""
    stored = client.call("gains_load", name=str(gains), text=gains.read_text(encoding="utf-8"))
    client.call("gains_activate", name=stored["name"], version=stored["version"])


def _go_home(client: ControlClient, home_rad: float) -> None:
    """Back to where the demo began, along half a cosine."""
    way_rad = home_rad - float(client.call("status")["motion"]["reference_rad"])
    if abs(way_rad) < 1e-9:
        return
    steps = round(_HOME_S * 1000)
    positions = [0.5 * way_rad * (1.0 - math.cos(math.pi * k / steps)) for k in range(steps + 1)]
    client.call("track", kind="csv", positions_rad=positions, renew_s=TOOL_RENEW_S)
    while _moves(client):
        pass


def _moves(client: ControlClient) -> bool:
    """Wait a little; then whether the motion still runs. Raises AnswerIsNo when the axis is not enabled any more."""
    time.sleep(_POLL_S)
    return motion_runs(client)


#: What follows when a process of the demo did not get its turn in time.
_STARVATION = frozenset(
    code.name
    for code in (
        FaultCode.DEADLINE_BUDGET,
        FaultCode.FEEDBACK_STALE,
        FaultCode.NODE_HEARTBEAT_LOST,
        FaultCode.SUPERVISOR_LOST,
    )
)


#: A loop that missed this share of its cycles did not get its turn, whatever fault came of it.
_MOST_MISSED = 0.01


def why(faults: Sequence[Mapping[str, Any]], missed_share: float) -> str:
    """The status document's faults with cause and remedy, and what is behind lateness where the bus is not real."""
    text = " ".join(f"{f['code']}: {f['cause']} {f['remedy']}" for f in faults)
    if missed_share <= _MOST_MISSED and _STARVATION.isdisjoint(fault["code"] for fault in faults):
        return text
    missed = f" ({missed_share:.0%} of the cycles were missed)" if missed_share > _MOST_MISSED else ""
    return (
        f"{text} Likely other programs took the processor{missed}: the demo on the wall clock wants the machine for "
        "itself; `servoctl demo --fast` does not."
    )


def motion_runs(client: ControlClient) -> bool:
    """Whether a motion runs. Raises AnswerIsNo with the faults when the axis is not enabled any more."""
    status: dict[str, Any] = client.call("status")
    if status["axis"]["state"] != "ENABLED":
        reasons = why(status["faults"], status["timing"]["missed"] / max(status["timing"]["cycle"], 1))
        raise AnswerIsNo(f"the axis went to {status['axis']['state']} while it was to move. {reasons}")
    if abandoned := status["motion"]["abandoned"]:
        raise AnswerIsNo(abandoned)
    return bool(status["axis"]["motion_running"])
