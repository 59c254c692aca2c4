"""For all tests: which of them want the machine for themselves, and how property tests behave on a shared one."""

from __future__ import annotations

import gc
import getpass
import os
import signal
import tempfile
from functools import cache
from pathlib import Path

import pytest
from hypothesis import settings

from tests import documents, starved
from tests.foreign import LEFT_OUT

# As the commands do, and before numpy is imported: threads on small matrices cost a factor of ten on a shared machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tables and logs are compared as text: screen, colours and service manager of whoever runs the tests are no part of it.
for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "JOURNAL_STREAM", "NOTIFY_SOCKET", "WATCHDOG_USEC"):
    os.environ.pop(name, None)
os.environ["TERM"] = "xterm"  # on a dumb one no bar is drawn

#: The longest path of a socket, and what pytest, a test's name and the socket's own add to the temporary folder.
SOCKET_PATH_BYTES = 107
ADDED_BYTES = len("/pytest-of-/pytest-999/popen-gw99/and_the_first_thirty_letters_12/folder/axis.socket")


def temporary_folder() -> str:
    """The usual one, or /tmp where the paths of sockets would be too long in it."""
    usual = tempfile.gettempdir()
    return usual if len(os.fsencode(usual + user())) + ADDED_BYTES <= SOCKET_PATH_BYTES else "/tmp"


def user() -> str:
    """Who runs the tests, as pytest names its folder."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no name for this number
        return "unknown"


os.environ["TMPDIR"] = tempfile.tempdir = temporary_folder()
os.environ.setdefault("XDG_RUNTIME_DIR", os.environ["TMPDIR"])  # where no login made one; root's would be /run/servod

ROOT = Path(__file__).resolve().parent

#: Every JSON document that a test has printed is one that the reference describes.
described = documents.described

#: Files (or folders) whose tests run an axis on the wall clock; `./test` runs two at a time, after all others.
SERIAL = (
    *("qualify/faults/test_control_attack.py", "qualify/faults/test_reactions.py"),
    *("runtime/daemon/test_daemon.py", "drivers/virtual/test_process.py", "foreign/test_devices.py"),
    "foreign/test_intruders.py",
)

#: More whose tests start real processes, beside others.
PROCESSES = (
    *("runtime/daemon", "cli", "conformance", "foreign", "lab/commission/test_daemon_tracking.py"),
    *("lab/identify/test_daemon_link.py", "lab/deploy/test_on_daemon.py", "lab/deploy/test_daemon_link.py"),
    *("qualify/faults/test_processes.py", "qualify/soak/test_wall.py"),
)

#: Files that take longest, the longest first: `./test` begins with them, so that no worker ends with one alone.
DEAREST = (
    *("lab/identify/test_walk.py", "lab/diagnose/test_drive.py", "qualify/faults/test_scenarios.py"),
    *("runtime/daemon/test_waiting.py", "cli/test_elsewhere.py", "qualify/paper/test_cli.py"),
    *("runtime/loop/test_channel_flips.py", "runtime/daemon/test_defence.py", "runtime/loop/test_foreign.py"),
    *("lab/deploy/test_deployment.py", "cli/test_synthesize.py", "lab/commission/test_walk.py", "cli/test_demo.py"),
    *("qualify/faults/test_processes.py", "lab/deploy/test_on_daemon.py", "tools/test_readme.py"),
    *("lab/verify/test_cli.py", "lab/synthesize/test_reference.py", "qualify/blind/test_cases.py"),
    *("runtime/daemon/test_daemon.py", "cli/test_verbs.py", "qualify/bench", "tools/test_blocks.py"),
    *("drivers/virtual/test_process.py", "qualify/faults/test_reactions.py", "lab/identify/test_daemon_link.py"),
    *("lab/diagnose", "lab/identify", "lab/verify", "lab/synthesize", "qualify/faults", "qualify/soak"),
    *("cli/test_plot.py", "qualify/blind", "lab/tune", "lab/commission", "cli/test_commission.py", "foreign"),
    *("runtime/loop/test_channel.py", "runtime/daemon", "formats/gains", "drivers", "cli", "tools"),
)

#: Markers of few files; `-m` with one of them first loads no others.
RARE = ("serial", "alone", "long")

# A loaded machine is no finding; the examples are what counts.
settings.register_profile("house", deadline=None)
settings.load_profile("house")


#: Recordings and programs of other people beside the project, which some tests want.
NAMES = ("recordings/emps", "recordings/bam_xl330", "recordings/odrive_cogging", "practice", "third_party")
SHARED = {name: ROOT.parents[1] / "shared" / name for name in NAMES}


def pytest_report_header() -> str:
    """Say what of other people is there: without it tests/lab/simulate/test_shared_data.py and tests/foreign have fewer
    tests."""
    there = (
        f"{name} {'present' if folder.is_dir() else 'ABSENT, its tests do not run'}" for name, folder in SHARED.items()
    )
    return "shared data: " + "; ".join(there)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say at the end which tests with other people's programs are left out, and why."""
    for pattern, reason in LEFT_OUT.items():
        terminalreporter.write_line(f"tests/foreign/{pattern} left out: {reason}")


def pytest_configure(config: pytest.Config) -> None:
    """Let failures on the wall clock be held against the machine's load, and children hear signals as in a terminal.

    What is ignored when the tests begin (SIGHUP under nohup(1), SIGINT in the background of a shell) every child would
    inherit; a handler it does not. The controller of several workers leaves it to them: they shall outlive a terminal.
    """
    judge = starved.Judge()
    config.pluginmanager.register(judge, "starved")
    config.pluginmanager.register(starved.Again(judge), "again")
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        for number in (signal.SIGHUP, signal.SIGINT):
            if signal.getsignal(number) is signal.SIG_IGN:
                signal.signal(number, lambda *_: None)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not load a file that has none of the few tests asked for: that takes longer than some of the tests."""
    wanted = config.getoption("markexpr").split(" ")[0]
    if wanted in RARE and collection_path.suffix == ".py" and not marked(collection_path, wanted):
        return True
    return None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of SERIAL and PROCESSES, before the selection by marker; the dearest files come first."""
    items.sort(key=lambda item: place_of(item.path))
    for item in items:
        for mark in marks_of(item.path):
            item.add_marker(mark)
        for name in RARE:
            if item.get_closest_marker(name) and not marked(item.path, name):
                raise pytest.UsageError(f"{item.path}: write mark.{name} into the file itself")


@cache
def marked(path: Path, name: str) -> bool:
    """Whether a file has tests of this marker: by its own words or by the tables above."""
    return f"mark.{name}" in path.read_text() or any(mark.name == name for mark in marks_of(path))


@cache
def place_of(path: Path) -> int:
    """Where in DEAREST a file stands, itself or its folder; all others behind."""
    return next((i for i, name in enumerate(DEAREST) if path.is_relative_to(ROOT / name)), len(DEAREST))


@cache
def marks_of(path: Path) -> list[pytest.MarkDecorator]:
    """What the tables above say of a file."""
    entries = ((SERIAL, pytest.mark.serial), (PROCESSES, pytest.mark.processes))
    return [mark for names, mark in entries if any(path.is_relative_to(ROOT / name) for name in names)]


def pytest_collection_finish() -> None:
    """Look for garbage less often, and never in what was loaded: that took a tenth of all the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)
