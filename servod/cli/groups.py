"""The help of `servoctl` in groups, one whole line for each verb, and names that the shell completes.

Imports typer alone, as all verbs do; what a completion offers is looked up when the shell asks.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

#: Widest help screen that is written for.
_WIDTH = 80


class Panel(StrEnum):
    """What a verb is for."""

    OPERATE = "Operate"
    COMMISSION = "Commission"
    ANALYSE = "Analyse"
    QUALIFY = "Qualify"


#: Every verb, in the order of the screen, with its line.
VERBS: dict[Panel, dict[str, str]] = {
    Panel.OPERATE: {
        "status": "Show state, goal, reasons and health of the axis.",
        "enable": "Enable the axis and wait until it is.",
        "disable": "Bring the axis to rest and switch the drive off.",
        "stop": "Stop the axis by the drive's quick stop.",
        "track": "Run a reference motion from where the axis stands.",
        "record": "Record every cycle; export a recording.",
        "gains": "Load, list, show, activate and roll back gain sets.",
        "faults": "Tell what happened on this axis, first cause first.",
    },
    Panel.COMMISSION: {
        "config": "Check configurations, gain sets, models and EDS files.",
        "scan": "List the nodes on the bus.",
        "preset": "Set the joint's zero in the encoder.",
        "guard-test": "Prove that the drive stops without its master.",
        "identify": "Identify the axis: inertia, friction, delay, noise.",
        "synthesize": "Compute a gain set for an axis model.",
        "verify": "Certify a gain set, or say why not.",
        "deploy": "Try a certified gain set on the axis; keep it if it does as promised.",
        "commission": "All of these in one walk, with a report.",
    },
    Panel.ANALYSE: {
        "plot": "Draw a recording: error, torque, states, faults.",
        "replay": "Simulate a model under a recorded torque.",
        "diagnose": "Find what physics a model leaves out.",
        "explain": "Explain an effect: equation, keys, units, ranges.",
        "export": "Write an axis model for another simulator.",
    },
    Panel.QUALIFY: {
        "demo": "Track a motion on the virtual axis under four laws.",
        "bench": "Measure how well this machine runs the loop.",
        "prove": "Put the diagnosis to a blind trial.",
        "qualify": "Try servod itself: fault campaign, soak, paper.",
    },
}

_SMALL_SINE = "servoctl track sine --amplitude 0.02 --frequency 0.2 --duration 10"

#: What comes next after each command, where the command itself does not know better (`servod.cli.common.suggest`).
NEXT: dict[str, str] = {
    "status": "servoctl enable   # tests the wiring, then holds the joint",
    "enable": f"{_SMALL_SINE}   # says how well the joint follows",
    "disable": "servoctl status",
    "guard-test": "servoctl enable   # once the daemon runs again",
    "stop": "servoctl status   # what state the axis is in; `servoctl enable` when it may move again",
    "track sine": "servoctl disable",
    "track paper": "servoctl disable",
    "track step": "servoctl disable",
    "track csv": "servoctl disable",
    "record start": f"{_SMALL_SINE}",
    "record stop": "servoctl plot FILE",
    "record export": "servoctl plot FILE   # the recording in pictures",
    "gains load": "servoctl gains list",
    "gains list": "servoctl gains activate NAME",
    "gains show": "servoctl gains load FILE --activate",
    "gains activate": f"{_SMALL_SINE}   # `servoctl gains rollback` undoes the change",
    "gains rollback": "servoctl gains list",
    "faults": "servoctl status   # what is latched now; `servoctl enable --reset-fault` when the cause is gone",
    "config check": "servoctl scan   # which nodes are there",
    "config keys": "servoctl config check FILE",
    "scan": "servoctl config check FILE   # with the nodes that were found",
    "preset": "servoctl enable",
    "identify": "servoctl synthesize --model MODEL --out gains.yaml",
    "synthesize": "servoctl verify GAINS",
    "verify": "servoctl deploy GAINS",
    "deploy": "servoctl track paper   # trajectory (19) under the new set",
    "commission": "servoctl track paper   # trajectory (19) under the new set",
    "plot": "servoctl replay --model MODEL REC   # what a model makes of the same torque",
    "replay": "servoctl diagnose --model MODEL REC --out diagnosis   # what the model leaves out",
    "diagnose": "servoctl synthesize --model MODEL --out gains.yaml   # from the model with the physics added",
    "explain": "servoctl diagnose --model MODEL REC --out diagnosis",
    "export": "servoctl explain EFFECT   # what the format leaves out, in equations",
    "demo": "servoctl commission --plant PLANT --out commissioning   # the whole way to a certified set",
    "bench": "servoctl config check FILE   # whether bus and period fit",
    "prove": "servoctl diagnose --model MODEL REC --out diagnosis   # the same on recordings of yours",
    "qualify faults": "servoctl qualify soak",
    "qualify soak": "servoctl bench",
    "qualify paper": "servoctl demo --fast",
}

#: Verbs that stand in the file of another one; every other verb has the file of its name.
_BESIDE = {"disable": "enable", "stop": "enable"}


def modules() -> list[str]:
    """The files of the verbs, in the order of the screen; each has a `register(app)`."""
    return list(dict.fromkeys(_BESIDE.get(name, name).replace("-", "_") for lines in VERBS.values() for name in lines))


class Grouped(TyperGroup):
    """Verbs below the title of their panel; a verb that VERBS does not know stands below the others."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the groups."""
        left = {name: command for name, command in self.commands.items() if not command.hidden}
        for panel, lines in VERBS.items():
            rows = [(name, line) for name, line in lines.items() if left.pop(name, None) is not None]
            self._write(formatter, panel, rows)
        self._write(formatter, "Others", [(name, c.get_short_help_str(_WIDTH)) for name, c in left.items()])

    def list_commands(self, ctx: Any) -> list[str]:
        """In the order of the screen."""
        order = [name for lines in VERBS.values() for name in lines]
        return sorted(self.commands, key=lambda name: order.index(name) if name in order else len(order))

    @staticmethod
    def _write(formatter: Any, title: str, rows: list[tuple[str, str]]) -> None:
        if rows:
            with formatter.section(title):
                formatter.write_dl(rows)


def effects(incomplete: str) -> list[str]:
    """Names of effects; none without the lab extra."""
    try:
        from servod.lab.diagnose.effects import NAMES
    except ImportError:
        return []
    return [name for name in NAMES if name.startswith(incomplete)]


def bus_interfaces(incomplete: str) -> list[str]:
    """Buses of servod's own and of python-can."""
    try:
        from can.interfaces import VALID_INTERFACES
    except ImportError:
        VALID_INTERFACES = frozenset()  # noqa: N806
    return sorted(name for name in {"virtual", "socketcan", *VALID_INTERFACES} if name.startswith(incomplete))


def stored_sets(ctx: typer.Context, incomplete: str) -> list[str]:
    """Gain sets in the daemon's store, where it answers at once."""
    from servod.client.control import ControlClient
    from servod.common.errors import ServodError
    from servod.formats.protocol import Verb

    socket = ctx.params.get("socket") or Path("/run/servod/axis.sock")
    try:
        with ControlClient(socket, timeout_s=1.0) as client:
            rows = client.call(Verb.GAINS_LIST)["gains"]
    except (ServodError, OSError):
        return []
    return sorted({row["name"] for row in rows if row["name"].startswith(incomplete)})


def scenario_groups(incomplete: str) -> list[str]:
    """Groups of the fault campaign."""
    try:
        from servod.qualify.faults.variants import shipped_scenarios
    except ImportError:
        return []
    return sorted({s.group for s in shipped_scenarios().values() if s.group.startswith(incomplete)})


def walk_steps(incomplete: str) -> list[str]:
    """Steps of a commissioning."""
    try:
        from servod.lab.commission.steps import STEPS
    except ImportError:
        return []
    return [step.name for step in STEPS if step.name.startswith(incomplete)]


def horizons(incomplete: str) -> list[str]:
    """A whole run, or the window that is usual."""
    return [text for text in ("full", "0.25", "1") if text.startswith(incomplete)]


def export_formats(incomplete: str = "") -> list[str]:
    """The languages that an axis model is exported to."""
    return [text for text in ("mujoco", "urdf", "json") if text.startswith(incomplete)]


def engines(incomplete: str) -> list[str]:
    """Who may move the axes of a blind trial."""
    return [text for text in ("own", "mujoco") if text.startswith(incomplete)]


def starts(incomplete: str) -> list[str]:
    """What a replay may take its first row for."""
    return [text for text in ("auto", "rest", "recorded") if text.startswith(incomplete)]
