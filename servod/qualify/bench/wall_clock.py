"""Daemon and virtual axis as two processes on the wall clock: missed periods, deadline to torque, memory.

A client of the control socket, like the demo. The figures of the loop come from the daemon's own recording.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

from servod.client.control import ControlClient
from servod.client.processes import running_axis, sigterm_as_interrupt, socket_folder
from servod.common.errors import AnswerIsNo
from servod.formats.recording.mcap_reader import read_recording
from servod.qualify.demo.axis import demo_config, gains_file, plant_file
from servod.qualify.demo.runs import Run, cut_motion
from servod.qualify.demo.wall_clock import activate, motion_runs

_SAMPLE_S = 0.5
#: Before this the history ring fills and the interpreter's arenas settle; growth counts from here on.
_SETTLE_S = 15.0
_AVERAGED = 10
_KIB_PER_MIB = 1024.0


def measure(wall_clock_s: float, memory_s: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """The figures of `wall_clock_s` and, after it, the growth of memory over `memory_s`, recording all the time."""
    with sigterm_as_interrupt(), socket_folder("servod-bench-") as name:
        folder = Path(name)
        with running_axis(demo_config(folder, folder / "recordings"), plant_file(None), folder) as (client, daemon_pid):
            activate(client, gains_file("local"))
            client.call("enable")
            client.call("track", kind="sine", amplitude_rad=0.05, frequency_hz=0.5, duration_s=3600.0, renew_s=None)
            run = _record(client, wall_clock_s)
            memory = _watch_memory(client, _processes(daemon_pid), memory_s)
            client.call("disable")
    return _wall_clock(run), memory


def _record(client: ControlClient, duration_s: float) -> Run:
    client.call("record_start")
    time.sleep(duration_s)
    _must_move(client)
    path = client.call("record_stop")["path"]
    return cut_motion("local", read_recording(path).rows)


def _wall_clock(run: Run) -> dict[str, Any]:
    import numpy as np

    sent_us, lag_us = run.rows["torque_sent_ns"] / 1e3, run.rows["lag_ns"] / 1e3
    return {
        "seconds": float(run.time_s[-1]),
        "missed_share": run.missed / run.cycles,
        "deadline_to_torque_us": float(np.median(sent_us)),
        "deadline_to_torque_p99_us": float(np.percentile(sent_us, 99)),
        "wakeup_us": float(np.median(lag_us)),
        "tick_us": float(np.median(run.rows["tick_ns"])) / 1e3,
    }


def _watch_memory(client: ControlClient, pids: dict[str, int], duration_s: float) -> dict[str, Any]:
    """Growth of supervisor and loop together, from the mean of the first samples after settling to that of the last."""
    client.call("record_start")
    time.sleep(min(_SETTLE_S, duration_s / 2.0))
    samples, end = [], time.monotonic() + duration_s
    while time.monotonic() < end:
        samples.append({name: resident_kib(pid) for name, pid in pids.items()})
        time.sleep(_SAMPLE_S)
    _must_move(client)
    client.call("record_stop")
    growth = {name: _growth_mib([sample[name] for sample in samples]) for name in pids}
    return {"growth_mib": sum(growth.values()), "seconds": duration_s, "processes_mib": growth}


def _processes(daemon_pid: int) -> dict[str, int]:
    """The supervisor and its only child, the loop (proc(5), task/children)."""
    (loop,) = Path(f"/proc/{daemon_pid}/task/{daemon_pid}/children").read_text(encoding="utf-8").split()
    return {"supervisor": daemon_pid, "loop": int(loop)}


def _growth_mib(samples_kib: list[int]) -> float:
    few = max(1, min(_AVERAGED, len(samples_kib) // 2))
    return (statistics.mean(samples_kib[-few:]) - statistics.mean(samples_kib[:few])) / _KIB_PER_MIB


def resident_kib(pid: int) -> int:
    """Resident memory of a process (proc(5), status: VmRSS); 0 when it has gone."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    return 0


def _must_move(client: ControlClient) -> None:
    if not motion_runs(client):
        raise AnswerIsNo("the motion ended before the benchmark")
