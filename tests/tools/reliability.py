"""The manual's table of what the axis was put through: soak, fault campaign and fuzzing, from their JSON documents."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

#: A row of the failure modes whose last cell begins with scenarios of one time; those of processes are `killed/both`.
_FAILURE = re.compile(r"^(?P<row>\| .* \|) (?P<times>[^|]*) \| `(?P<name>[\w/ .-]+)`(?P<more>[^|]*) \|$", re.MULTILINE)
#: A row of the short table above it: left and gone in a cell each.
_DEATH = re.compile(
    r"^(?P<row>\| .* \|) (?P<left>\d+) \| (?P<gone>\d+) \| (?P<last>`[\w ]*--only '?(?P<name>[\w/ .-]+)'?`) \|$",
    re.MULTILINE,
)
HEADER = ["Put through", "How much", "Came out", "Command"]
Row = list[str]


def rows(
    soaks: Sequence[dict[str, Any]], faults: dict[str, Any] | None, fuzz: list[dict[str, Any]] | None
) -> list[Row]:
    """A row for each document that there is, two for the campaign's kinds of loss."""
    return [
        *(_soak(soak) for soak in soaks),
        *(_faults(faults) if faults is not None else ()),
        *([_fuzz(fuzz)] if fuzz is not None else []),
    ]


def _soak(soak: dict[str, Any]) -> Row:
    """Cycles, faults and what was wrong in them."""
    how = "SYNC-stepped" if soak["mode"] == "stepped" else "daemon, loop and virtual axis as processes"
    much = (
        f"{soak['cycles']:,} cycles ({soak['axis_hours']:.1f} h of axis time in {soak['wall_s'] / 3600.0:.2f} h), "
        f"{soak['faults_injected']:,} faults of {len(soak['faults'])} kinds, {soak['restarts']:,} restarts"
    )
    gone_ms = max((fault["torque_gone"]["largest_ms"] for fault in soak["faults"].values()), default=0.0)
    lost = soak["cycles"] - soak["missed"] - soak["rows"]
    out = [
        f"{lost:,} rows lost",
        f"{abs(soak['rows'] - soak['syncs'] - soak['syncs_taken']):,} apart from SYNC on the bus",
        *_met(soak["faults"].values()),
        f"{sum(soak['wrong'].values()):,} unexplained states, faults or torques",
        f"torque gone after {gone_ms:.0f} ms at the latest",
        *(f"memory of {memory['process']} {_memory(memory)}" for memory in soak["memory"]),
        *(f"no pass: {reason}" for reason in soak.get("unproven", ())),
    ]
    command = "servoctl qualify soak" + (" --wall" if soak["mode"] == "wall" else "")
    return [f"random moves and faults, {how}", much, "; ".join(out), f"`{command}`"]


def _met(faults: Iterable[dict[str, Any]]) -> Iterator[str]:
    """How the kinds that must be told in the log, and those that the axis rides through, were met."""
    told, ridden = [], []
    for fault in faults:
        (told if _due(fault) else ridden).append(fault)
    yield f"{_sum(told, 'found'):,} of {_sum(told, 'injected'):,} faults that stop the axis in the log"
    others = f"{_sum(ridden, 'injected'):,} others"
    if not all("ridden" in fault for fault in ridden):  # an older document, which has no trace of them
        yield f"enabled after {_sum(ridden, 'recovered'):,} of {others}"
        return
    yield f"{_sum(ridden, 'ridden'):,} of {others} seen on the bus and ridden through"
    if spoilt := _sum(ridden, "spoilt"):
        yield f"{spoilt:,} of them seen on the bus and the wiring tested again"


def _due(fault: dict[str, Any]) -> bool:
    """Whether faults of this kind must be told in the log; older documents tell it by the times of the reaction, which
    are taken for these alone."""
    if "due" in fault:
        return bool(fault["due"])
    return bool(fault["torque_gone"]["count"]) or fault["found"] < fault["injected"]


def _sum(faults: Iterable[dict[str, Any]], name: str) -> int:
    return sum(fault[name] for fault in faults)


def _memory(memory: dict[str, Any]) -> str:
    low, high = memory["interval_kb_per_h"]
    return memory["growth"] if low is None else f"{memory['growth']} ({low:.0f} to {high:.0f} kB/h)"


def _faults(faults: dict[str, Any]) -> Iterator[Row]:
    """The campaign as a whole, and the worst times of each kind of loss by the drive's own record."""
    much, passed = f"{faults['run']:,} of {faults['planned']:,} scenarios", f"{faults['passed']:,} passed"
    if faults.get("recorded", 1):  # documents of before there was the key were of processes
        lost = f"{faults['lost_records']:,} cycle records lost"
        lost += f" in {faults['recorded']:,} with a recorder" if "recorded" in faults else ""
        yield ["fault campaign", much, f"{passed}; {lost}", "`servoctl qualify faults`"]
    else:  # nothing records where time is stepped
        yield ["fault campaign, in virtual time", much, passed, "`servoctl qualify faults --stepped`"]
    for loss, worst in faults["worst"].items():
        if worst["scenarios"]:
            times = [
                f"{text} after {worst[key]:.0f} ms at the latest"
                for key, text in (("left_ms", "the drive had left the command"), ("gone_ms", "the torque was gone"))
                if worst[key] is not None
            ]
            yield [f"of these, loss of {loss}", f"{worst['scenarios']:,} scenarios", "; ".join(times), ""]


def _fuzz(fuzz: list[dict[str, Any]]) -> Row:
    """Inputs and crashes over all targets."""
    inputs, hours = sum(row["inputs"] for row in fuzz), sum(row["seconds"] for row in fuzz) / 3600.0
    targets = sorted({row["target"] for row in fuzz})
    crashes = {(row["target"], crash["key"]) for row in fuzz for crash in row["crashes"]}
    much = f"{inputs:,} inputs to {len(targets)} ways in, {hours:.2f} h"
    return ["fuzzing", much, f"{len(crashes):,} crashes", "`python -m tests.fuzz.run`"]


def with_times(text: str, faults: dict[str, Any]) -> str:
    """Both tables of the safety page with the times of a campaign: the drive left the command / the torque was gone.

    A row keeps its cell where its scenario did not run or has no such times. Raises ValueError where an axis rode
    through that the table lets stop, or the other way round.
    """
    ran = {scenario["name"]: scenario for scenario in faults["scenarios"]}

    def timed(row: re.Match[str]) -> str:
        if (scenario := ran.get(row["name"])) is None:
            return row[0]
        if (scenario["axis"] == "ENABLED") != (row["times"] == "rides"):
            raise ValueError(f"{row['name']}: {scenario['axis']}, in the table {row['times']}")
        left, gone = scenario["left_ms"], scenario["gone_ms"]
        if left is None or gone is None or row["times"] in ("rides", "no torque"):
            return row[0]
        times = f"{left:.0f}" if f"{left:.0f}" == f"{gone:.0f}" else f"{left:.0f} / {gone:.0f}"
        return f"{row['row']} {times} | `{row['name']}`{row['more']} |"

    def died(row: re.Match[str]) -> str:
        left, gone = (ran.get(row["name"], {}).get(key) for key in ("left_ms", "gone_ms"))
        return row[0] if left is None or gone is None else f"{row['row']} {left:.0f} | {gone:.0f} | {row['last']} |"

    return _DEATH.sub(died, _FAILURE.sub(timed, text))
