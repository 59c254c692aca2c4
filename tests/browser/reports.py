"""Every page that servoctl writes, made by the command that writes it.

A page costs seconds to two minutes; the jobs share the cores, and what has been made is kept on request. The axis of
`plot` and `track --plot` is the virtual one, on the wall clock for some seconds.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEMO_JOINT = "gains/axes/demo_joint.yaml"
#: Every command ends in this time, s; the longest of them takes two minutes of an idle core.
_LIMIT_S = 900.0
#: The recording that must zoom into a sine: so many rows at this rate.
SINE_HZ, SINE_RAD, RATE_HZ, SINE_ROWS = 20.0, 0.01, 1000, 60_000
#: Limits and gains of the axis: those of the README's first steps.
_AXIS = """
bus: {{interface: virtual, channel: bus}}
limits: {{torque_nm: 0.3, torque_rate_nm_per_s: 200.0, speed_rad_s: 3.0, position_min_rad: -0.6, position_max_rad: 0.6,
         following_error_rad: 0.15, encoder_mismatch_rad: 0.05, stale_cycles: 50, late_cycles: 500}}
gains: {{directory: gains, initial: {gains}, accept_uncertified: true}}
control: {{socket: axis.sock, group: {group}}}
recorder: {{directory: recordings}}
"""


class Failed(Exception):
    """A command did not do what it should: its words, and the end of what it printed."""


@dataclass(frozen=True)
class Report:
    """One page: where it lies below the folder of all reports, who writes it, what makes it, and with which further
    words it does so where only the look of the page counts, not its figures.
    """

    page: str
    module: str
    make: Callable[..., None]
    quick: tuple[object, ...] = ()

    @property
    def name(self) -> str:
        """The folder of the page, which names the report."""
        return self.page.partition("/")[0]


def servoctl(*words: object, codes: tuple[int, ...] = (0,), socket: Path | None = None) -> str:
    """Run a command as somebody in the checkout would; returns what it printed. Raises Failed."""
    environment = os.environ | ({"SERVOD_SOCKET": str(socket)} if socket else {})
    done = subprocess.run(
        [sys.executable, "-m", "servod.cli", *map(str, words)],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=_LIMIT_S,
        check=False,
    )
    if done.returncode not in codes:
        raise Failed(f"servoctl {' '.join(map(str, words))}: {done.returncode}: {done.stderr[-1500:]}")
    return done.stdout


@contextlib.contextmanager
def axis(folder: Path) -> Iterator[Path]:
    """A virtual axis and its daemon, for the time of a `with` block; gives the control socket."""
    import grp

    folder.mkdir(parents=True)
    group = grp.getgrgid(os.getgid()).gr_name
    (folder / "axis.yaml").write_text(_AXIS.format(gains=ROOT / "gains/demo_pd.yaml", group=group))
    socket = folder / "axis.sock"
    with (
        _running(
            "servod.drivers.virtual.main", "--socket", folder / "bus", "--plant", DEMO_JOINT, until=folder / "bus"
        ),
        _running("servod.runtime.daemon.main", "--config", folder / "axis.yaml", until=socket),
    ):
        yield socket


@contextlib.contextmanager
def _running(module: str, *words: object, until: Path) -> Iterator[None]:
    process = subprocess.Popen(
        [sys.executable, "-m", module, *map(str, words)], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        end_s = time.monotonic() + 60.0
        while not until.exists():
            if process.poll() is not None or time.monotonic() > end_s:
                raise Failed(f"{module} did not begin: {process.returncode}")
            time.sleep(0.1)
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(20.0)


# --- What makes each page ---------------------------------------------------------------------------------------------


def _by(*words: object, codes: tuple[int, ...] = (0,)) -> Callable[..., None]:
    """One command that takes the folder with --out."""

    def make(folder: Path, *quick: object) -> None:
        servoctl(*words, *quick, "--out", folder, codes=codes)

    return make


def _diagnosis(folder: Path) -> None:
    """Of an axis that conceals something, drawn as the blind trial draws them."""
    servoctl("prove", "--only", "cases", "--cases", 1, "--seed", 7, "--out", folder / "drawn")
    case = folder / "drawn/c000"
    recordings = sorted(case.glob("rec_*.csv.gz"))
    told = ("--model", case / "model.yaml", "--time-limit", 600, "--out", folder / "diagnosis")
    servoctl("diagnose", *told, *recordings)


def _motion(folder: Path) -> None:
    """A motion that ran on the wall clock, and the recording of it with a fault in it."""
    with axis(folder / "axis") as socket:
        servoctl("enable", socket=socket)
        servoctl("record", "start", "--name", "run.mcap", socket=socket)
        sine = ("--amplitude", 0.1, "--frequency", 0.5, "--duration", 4)
        servoctl("track", "sine", *sine, "--plot", folder / "motion.html", socket=socket)
        servoctl("stop", socket=socket)
        servoctl("record", "stop", socket=socket)
    servoctl("plot", folder / "axis/recordings/run.mcap", "--out", folder / "run.html")


def write_sine(file: Path) -> None:
    """A minute of a fast sine: from afar a band, from near a sine."""
    lines = ["t_s,position_rad,reference_rad,torque_nm"]
    for k in range(SINE_ROWS):
        t = k / RATE_HZ
        wave = math.sin(2.0 * math.pi * SINE_HZ * t)
        lines.append(f"{t:.3f},{SINE_RAD * wave:.9f},{1.01 * SINE_RAD * wave:.9f},{0.02 * wave:.9f}")
    file.write_text("\n".join(lines) + "\n")


def _sine(folder: Path) -> None:
    write_sine(folder / "sine.csv")
    servoctl("plot", folder / "sine.csv", "--out", folder / "sine.html")


#: The longest first, so that none is waited for at the end.
REPORTS = (
    Report(
        "commission/report.html",
        "servod.lab.commission.report",
        _by("commission", "--yes", "--plant", DEMO_JOINT),
        ("--budget", 60),  # plants for each rival's tuning; fewer than 1000 plants of --plants certify nothing
    ),
    Report(
        "retrofit/report.html",
        "servod.qualify.demo.recovery.walk",
        _by("demo", "--fast", "--diagnose", "--conceal", "asymmetry"),
    ),
    Report("paper/paper.html", "servod.qualify.paper.document", _by("qualify", "paper", "--quick")),
    Report("demo/report.html", "servod.qualify.demo.report", _by("demo", "--fast")),
    Report("prove/prove.html", "servod.qualify.blind.document", _by("prove", "--cases", 2, "--seed", 7)),
    Report("diagnose/diagnosis/report.html", "servod.lab.report.diagnosis", _diagnosis),
    Report("track/motion.html", "servod.cli.plot", _motion),
    Report("plot/sine.html", "servod.cli.plot", _sine),
    Report(
        "faults/report.html",
        "servod.qualify.faults.run",
        _by("qualify", "faults", "--stepped", "--only", "torque_frames*"),
    ),
    Report("soak/soak.html", "servod.qualify.soak.document", _by("qualify", "soak", "--cycles", 20_000)),
)
#: Pages that a command above leaves beside its own.
BESIDE = ("track/run.html",)


def make(out: Path, names: set[str], keep: bool, jobs: int, quick: bool = False) -> Iterator[tuple[Path, str]]:
    """Make the pages of these reports (all where there is no name): each file, and why it is not there."""
    chosen = [report for report in REPORTS if not names or report.name in names]

    def one(report: Report) -> tuple[Report, str]:
        folder = out / report.name
        if not (keep and (out / report.page).exists()):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            begun_s = time.monotonic()
            try:
                report.make(folder, *(report.quick if quick else ()))
            except (Failed, subprocess.TimeoutExpired) as error:
                return report, str(error)
            print(f"{report.name:<12} made in {time.monotonic() - begun_s:.0f} s", flush=True)
        return report, ""

    with ThreadPoolExecutor(jobs) as pool:
        for made in as_completed([pool.submit(one, report) for report in chosen]):
            report, error = made.result()
            yield out / report.page, error
            beside = [page for page in BESIDE if page.startswith(f"{report.name}/")]
            yield from ((out / page, "") for page in beside if not error)
