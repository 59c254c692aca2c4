"""`servoctl faults`: what happened on this axis, first cause first; or the table of all faults."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from servod.cli.common import DEFAULT_SOCKET, JsonOption, SocketOption, ask, example, print_json, table_console
from servod.common.errors import BadInput, Unreachable, one_line
from servod.common.faults import FAULTS
from servod.common.files import BadFile

if TYPE_CHECKING:
    from servod.formats.recording.incidents import Incident

_HELP = example(
    "Tell what happened on this axis: the first cause of each stop, what followed it, when, and which file has the "
    "seconds before. The daemon is asked; what it does not know any more, or where none runs, is read from the fault "
    "files in the recordings folder. --journal reads saved log lines, REC... recordings. --codes prints the table of "
    "faults with cause and remedy.",
    "servoctl faults",
    "servoctl faults --config /etc/servod/config/can0.yaml --last 3",
    "servoctl faults axis-fault-20260115-093000-BUS_OFF.mcap --json",
    "servoctl faults --codes",
)
_FOLDER = Path("/var/lib/servod/recordings")
#: The way on without a daemon.
_OTHER_FOLDER = "another one: --config AXIS.yaml, or --recordings FOLDER"


class _Asked(NamedTuple):
    """Where to look."""

    socket: Path
    folder: Path | None
    axis: str | None
    most: int


def register(app: typer.Typer) -> None:
    """Add the verb to `app`."""
    app.command("faults", help=_HELP)(faults)


def faults(
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[REC...]", help="Recordings (.mcap) to look into instead.")
    ] = None,
    folder: Annotated[Path | None, typer.Option("--recordings", help="Folder with fault files; no daemon.")] = None,
    journal: Annotated[
        Path | None, typer.Option(help="Log lines instead: `journalctl -o short-iso` of the unit, in a file.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="Axis configuration: names socket and recordings folder.")] = None,
    last: Annotated[int, typer.Option(min=1, max=1000, help="So many incidents, the newest.")] = 10,
    codes: Annotated[bool, typer.Option("--codes", help="The table of all faults, and nothing else.")] = False,
    socket: SocketOption = DEFAULT_SOCKET,
    as_json: JsonOption = False,
) -> None:
    """Tell what happened, or print the fault table."""
    given = {"REC": recordings, "--recordings": folder, "--journal": journal, "--config": config}
    _refuse_together({name for name, value in given.items() if value}, codes)
    if codes:
        _print_codes(as_json)
        return
    asked = _Asked(socket, folder, None, last)
    if config is not None:
        from servod.formats.config import load_config

        axis = load_config(config)
        asked = _Asked(axis.control.socket, axis.recorder.directory, axis.name, last)
    if recordings or journal:
        document = _of_files(recordings or [], journal, last)
    else:
        document = _of_folder(asked) if folder is not None else _of_axis(asked)
    if as_json:
        print_json(document)
    else:
        _print(document)


def _refuse_together(given: set[str], codes: bool) -> None:
    """One place to look at, or the table. Raises BadInput."""
    if codes and given:
        raise BadInput("--codes", f"beside {sorted(given)[0]}", "alone or with --json: it lists all faults")
    if len(given) > 1:
        first, second, *_ = sorted(given)
        raise BadInput(first, f"beside {second}", "one of REC, --recordings, --journal and --config")


def _of_files(recordings: list[Path], journal: Path | None, most: int) -> dict[str, Any]:
    from servod.formats.recording.incidents import newest, of_file, of_journal

    found = [incident for path in recordings for incident in of_file(path)]
    if journal is not None:
        found = of_journal(journal)
    return _document("journal" if journal else "recordings", None, [i.document() for i in newest(found, most)])


def _of_folder(asked: _Asked) -> dict[str, Any]:
    """What the fault files of a folder tell."""
    folder = asked.folder or _FOLDER
    if not folder.is_dir():
        raise BadFile(str(folder), "there is no such folder", "the folder of the recordings")
    rows, unread = _read(folder, asked.axis, asked.most, set())
    return _document("recordings", None, rows, unread) | {"folder": str(folder)}


def _of_axis(asked: _Asked) -> dict[str, Any]:
    """The daemon's incidents and, from before its start, the fault files. Raises Unreachable where neither is there."""
    from servod.formats.protocol import Verb

    try:
        answer = ask(asked.socket, Verb.FAULTS)
        now = [fault["code"] for fault in ask(asked.socket, Verb.STATUS)["faults"]]
    except Unreachable as error:
        if not (asked.folder or _FOLDER).is_dir():
            nowhere = f"And there is no folder of recordings, {asked.folder or _FOLDER}"
            raise Unreachable(f"{error} {nowhere}; {_OTHER_FOLDER}") from None
        return _of_folder(asked) | {"daemon": str(error)}
    rows: list[dict[str, Any]] = answer["incidents"][::-1][: asked.most]
    folder = Path(answer["directory"])
    unread: list[str] = []
    if len(rows) < asked.most:
        with suppress(OSError):
            earlier, unread = _read(folder, answer["name"], asked.most, {row["file"] for row in rows})
            rows = [*rows, *(row for row in earlier if not _is_known(row, rows))][: asked.most]
    return _document("daemon", now, rows, unread) | {"folder": str(folder)}


def _is_known(row: dict[str, Any], rows: list[dict[str, Any]]) -> bool:
    """Whether the daemon has told of this file's incident already, before the file was written."""
    return any(row["time"] == other["time"] and row["code"] == other["code"] for other in rows)


def _read(folder: Path, axis: str | None, most: int, known: set[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """The newest incidents of fault files and marks of runs, and which of these cannot be read and why."""
    from servod.formats.recording.incidents import fault_files, marks, newest, of_file, of_mark

    found: list[Incident] = []
    ends: list[Incident] = []
    unread: list[str] = []
    for path in marks(folder, axis):
        try:
            ends += of_mark(path)
        except BadInput as error:
            unread.append(str(error))
    for path in fault_files(folder, axis):
        if len(found) >= most:
            break
        if str(path) in known:
            continue
        try:
            found += of_file(path)
        except BadInput as error:
            unread.append(str(error))
    return [incident.document() for incident in newest([*found, *ends], most)], unread


def _document(
    source: str, now: list[str] | None, rows: list[dict[str, Any]], unread: list[str] | None = None
) -> dict[str, Any]:
    """`now`: faults that are latched, which only a daemon knows."""
    return {"source": source, "now": now, "incidents": rows, "not_read": unread or []}


def _print(document: dict[str, Any]) -> None:
    if "daemon" in document:
        print(f"{document['daemon']} From the fault files in {document['folder']} ({_OTHER_FOLDER}):")
    if document["now"]:
        print(f"latched now: {', '.join(document['now'])}")
    for row in document["incidents"]:
        _print_incident(row)
    for line in document["not_read"]:
        print(f"not read: {one_line(line)}")
    if not document["incidents"]:
        print("no fault is on record")


def _print_incident(row: dict[str, Any]) -> None:
    """A line of when and what, and indented what followed, what helps, and where to look."""
    name = f" {one_line(row['axis'])}" if row["axis"] else ""
    detail = f" [{one_line(row['detail'])}]" if row["detail"] else ""
    print(f"{row['time']}{name}: {row['code']} ({_words(row['reaction'])}). {row['cause']}{detail}")
    for other in row["faults"]:
        if other["code"] != row["code"]:
            when = f"{abs(other['after_s']):.3f} s {'before' if other['after_s'] < 0 else 'later'}"
            print(f"    {when}: {other['code']} ({_words(other['reaction'])})")
    print(f"    to do: {row['remedy']}")
    if row["file"]:
        print(f"    the seconds before: {one_line(row['file'])}")


def _words(reaction: str) -> str:
    return reaction.lower().replace("_", " ")


def _print_codes(as_json: bool) -> None:
    rows = FAULTS.values()
    if as_json:
        print_json(
            [
                {
                    "code": f.code.name,
                    "bit": int(f.code),
                    "reaction": f.reaction.name,
                    "cause": f.cause,
                    "remedy": f.remedy,
                }
                for f in rows
            ]
        )
        return
    from rich.table import Column, Table

    cause, remedy = (Column(head, overflow="fold") for head in ("Cause", "Remedy"))
    table = Table("Fault", "Reaction", cause, remedy)
    for fault in rows:
        table.add_row(fault.code.name, fault.reaction.name, fault.cause, fault.remedy)
    table_console().print(table)
