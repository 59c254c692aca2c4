"""What befell an axis: faults that belong together, in the order of their times, from fault files or the journal.

Behind the recorder. The daemon keeps its own incidents in the same form (servod.runtime.daemon.fault_watch); `servoctl
faults` prints them. All times are of the clock on the wall, in ns since 1970.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from servod.common.errors import BadInput
from servod.common.faults import FAULTS, FaultCode, Reaction, faults_in
from servod.common.files import read_text
from servod.common.units import NS_PER_S
from servod.formats.recording.mcap_reader import McapRecording, read_recording
from servod.formats.recording.run_mark import ENDING, AbruptEnd, abrupt_ends

#: A fault that comes later than this after the one before it has a cause of its own.
QUIET_NS = 10 * NS_PER_S
_MOST_FAULTS = 100
_NEVER_NS = 2**63
_ENABLING = 1  # servod.runtime.loop.axis_state.AxisState, which stands above
_FILE = re.compile(r"(?P<axis>.+)-fault-(?P<stamp>\d{8}-\d{6})-\w+?(-\d+)?\.mcap")
_LINE = re.compile(r"\bfault (?P<code>[A-Z_]+) \((?P<reaction>[A-Z_]+)\): (?P<text>.*)")
#: What journalctl says of itself: "-- No entries --", "-- Boot … --".
_REMARK = "-- "
#: How journalctl (short-iso, short-iso-precise) and the daemon itself write when a line came.
_STAMP = re.compile(r"(\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](\d{1,6}))?([+-]\d\d:?\d\d|Z)?")


class Seen(NamedTuple):
    """One fault when it appeared; `detail` is what was known beyond the table's cause."""

    time_ns: int
    code: FaultCode
    detail: str = ""

    @property
    def stops(self) -> bool:
        """Whether it brings the axis to rest; what only clips or is told is rarely the cause of what follows."""
        return FAULTS[self.code].reaction > Reaction.CLIP


@dataclass
class Incident:
    """Faults that belong together; `file` has the seconds before, empty where none was written."""

    axis: str = ""
    faults: list[Seen] = field(default_factory=list)
    file: str = ""

    def add(self, seen: Seen) -> None:
        """One more fault; of too many the last ones tell nothing new."""
        if len(self.faults) < _MOST_FAULTS:
            self.faults.append(seen)

    def goes_on(self, time_ns: int) -> bool:
        """Whether a fault at this time would still belong to it."""
        return bool(self.faults) and time_ns - self.faults[-1].time_ns <= QUIET_NS

    @property
    def first(self) -> Seen:
        """The first cause: the earliest that stops the axis, else the earliest; of one cycle the strongest."""
        stopping = [seen for seen in self.faults if seen.stops] or self.faults
        return min(stopping, key=lambda seen: (seen.time_ns, -FAULTS[seen.code].reaction, seen.code))

    def document(self) -> dict[str, Any]:
        """Plain values for people and programs."""
        first, fault = self.first, FAULTS[self.first.code]
        return {
            "time": moment(first.time_ns),
            "axis": self.axis,
            "code": fault.code.name,
            "reaction": fault.reaction.name,
            "cause": fault.cause,
            "detail": first.detail,
            "remedy": fault.remedy,
            "faults": [
                {
                    "code": seen.code.name,
                    "reaction": FAULTS[seen.code].reaction.name,
                    "after_s": round((seen.time_ns - first.time_ns) / NS_PER_S, 6),
                    "detail": seen.detail,
                }
                for seen in self.faults
            ],
            "file": self.file,
        }


def moment(time_ns: int) -> str:
    """Local time with its zone, to the millisecond."""
    return datetime.fromtimestamp(time_ns / NS_PER_S).astimezone().isoformat(" ", timespec="milliseconds")


def grouped(seen: Iterable[Seen], axis: str = "", one_stop: bool = False) -> list[Incident]:
    """Incidents of faults in the order of time; with `one_stop` a single one, however long it took."""
    found: list[Incident] = []
    for one in sorted(seen, key=lambda s: s.time_ns):
        if not found or not (one_stop or found[-1].goes_on(one.time_ns)):
            found.append(Incident(axis))
        found[-1].add(one)
    return found


def fault_files(folder: Path, axis: str | None = None) -> list[Path]:
    """The files of the seconds before faults in `folder`, newest first; of one axis where its name is given."""
    named = [(path, _FILE.fullmatch(path.name)) for path in folder.glob("*-fault-*.mcap")]
    own = [(path, match) for path, match in named if match and axis in (None, match["axis"])]
    return [path for path, _ in sorted(own, key=lambda one: (one[1]["stamp"], one[0].name), reverse=True)]


def of_file(path: Path) -> list[Incident]:
    """What a recording shows: of a fault file, the incident that it was written for. Raises BadInput."""
    recording = read_recording(path, {"faults", "faults_latched", "axis_state"})
    match = _FILE.fullmatch(path.name)
    found = grouped(_appeared(recording), match["axis"] if match else "", one_stop=bool(match))
    for incident in found:
        incident.file = str(path)
    return found


def _appeared(recording: McapRecording) -> list[Seen]:
    """Every fault when it came up, in the cycles and, where the supervisor found it, in the events."""
    try:
        times, present = recording.column("time_ns"), recording.column("faults")
        latched, states = recording.column("faults_latched"), recording.column("axis_state")
    except KeyError:
        return []
    details = {event.get("code"): _detail(event) for event in recording.events if event.get("kind") == "fault"}
    found: list[Seen] = []
    known, ever, before = 0, 0, -1
    for time_ns, now, stays, state in zip(times, present, latched, states, strict=True):
        word = now | stays
        if state == _ENABLING != before:
            known &= word
            found.clear()  # what was before an enable is over
        before = state
        if new := word & ~known:
            found += [Seen(time_ns, fault.code, details.get(fault.code.name, "")) for fault in faults_in(new)]
            known |= word
            ever |= word
    others = set(FaultCode.__members__) - {fault.code.name for fault in faults_in(ever)}
    for event in recording.events:
        within = len(times) > 0 and times[0] <= event.get("time_ns", 0)
        if within and event.get("kind") == "fault" and event.get("code") in others:
            found.append(Seen(event["time_ns"], FaultCode[event["code"]], _detail(event)))
    return [seen._replace(time_ns=seen.time_ns + recording.wall_offset_ns) for seen in found]


def _detail(event: dict[str, Any]) -> str:
    """What stands in brackets between the table's cause and remedy."""
    code = FaultCode.__members__.get(str(event.get("code")))
    return "" if code is None else _between(str(event.get("text", "")), FAULTS[code].cause)


def _between(text: str, cause: str) -> str:
    match = re.match(r" \[(.*?)\] ", text.removeprefix(cause)) if text.startswith(cause) else None
    return match[1] if match else ""


def of_abrupt_end(end: AbruptEnd, axis: str = "", now_ns: int = _NEVER_NS) -> Incident:
    """The end of a run without an orderly stop, at the time when the daemon was last seen alive.

    When it was found ended says something only where a next start found it: from `now_ns` on, that is who asks.
    """
    known = f"last known to live at {moment(end.seen_ns)}"
    if end.found_ns < now_ns:
        known += f", found ended by the start at {moment(end.found_ns)}"
    return Incident(axis, [Seen(end.seen_ns, FaultCode.DAEMON_LOST, known)])


def of_mark(path: Path) -> list[Incident]:
    """The ends without an orderly stop that the mark of an axis's runs tells. Raises BadInput."""
    now_ns = time.time_ns()
    return [of_abrupt_end(end, path.name.removesuffix(ENDING), now_ns) for end in abrupt_ends(path, now_ns)]


def marks(folder: Path, axis: str | None = None) -> list[Path]:
    """The marks of runs in `folder`; that of one axis where its name is given."""
    return sorted(path for path in folder.glob(f"*{ENDING}") if axis in (None, path.name.removesuffix(ENDING)))


def of_journal(path: Path) -> list[Incident]:
    """Incidents in the daemon's log lines, as `journalctl -o short-iso` or the daemon writes them. Raises BadInput."""
    found: list[Seen] = []
    lines = [line for line in read_text(path).splitlines() if not line.startswith(_REMARK)]
    if any(map(str.strip, lines)) and not any(_STAMP.search(line) or _LINE.search(line) for line in lines):
        raise BadInput(str(path), "no line with a date", "lines of `journalctl -o short-iso` of the unit")
    for line in lines:
        match = _LINE.search(line)
        if match is None or match["code"] not in FaultCode.__members__:
            continue
        stamp = _STAMP.search(line[: match.start()])
        if stamp is None:
            where, allowed = f"{path}: {match['code']}", "lines of `journalctl -o short-iso`"
            raise BadInput(where, "a line without its date", allowed)
        code = FaultCode[match["code"]]
        found.append(Seen(_time_ns(stamp), code, _between(match["text"], FAULTS[code].cause)))
    return grouped(found)


def _time_ns(stamp: re.Match[str]) -> int:
    zone = (stamp[3] or "").replace("Z", "+00:00")
    parsed = datetime.fromisoformat(f"{stamp[1].replace(' ', 'T')}{zone}")
    local = parsed if zone else parsed.astimezone()
    return int(local.timestamp()) * NS_PER_S + int((stamp[2] or "0").ljust(9, "0"))


def newest(incidents: Sequence[Incident], most: int) -> list[Incident]:
    """At most so many, newest first; of one that several files show, as each later one has it in its history, the
    fullest."""
    fullest: dict[tuple[str, str, FaultCode], Incident] = {}
    for incident in sorted(incidents, key=lambda incident: len(incident.faults)):
        fullest[incident.axis, moment(incident.first.time_ns), incident.first.code] = incident
    return sorted(fullest.values(), key=lambda incident: incident.first.time_ns, reverse=True)[:most]
