"""Runs every step, also after one that failed; the results are on the host as soon as they stand."""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
import traceback
from functools import partial
from pathlib import Path
from typing import Any

from inside.tools import shell, unless_starved

#: Module and step; a module is imported when its first step comes, since only the first one can do without servod.
STEPS = (
    ("install", "install"),
    ("bus", "conformance"),  # while nobody else is on the bus
    ("service", "readiness"),
    ("service", "started"),
    ("service", "sandbox"),
    ("service", "motion"),
    ("bus", "witness"),
    ("service", "rights"),
    ("service", "reload"),
    ("service", "restart"),
    ("service", "watchdog"),
    ("service", "loop_stopped"),
    ("service", "supervisor_killed"),
    ("service", "loop_killed"),
    ("faults", "campaign"),
    ("service", "bad_configuration"),
    ("service", "stop"),
    ("foreign", "foreign"),  # on a bus of its own
    ("bus", "own_bus"),  # takes the interface away from all others
)
#: Steps that leave nothing behind, so that they can be run again where the host kept the processor from them.
ON_THEIR_OWN = ("foreign",)
#: Only where it is named.
ON_REQUEST = (("power", "powered"),)


def main() -> None:
    """Step after step into SHARE/results.jsonl; with names behind SHARE only these."""
    share, *chosen = sys.argv[1:]
    with (Path(share) / "results.jsonl").open("w") as results:
        for module, step in (*STEPS, *ON_REQUEST):
            if step not in chosen and (chosen or (module, step) in ON_REQUEST):
                continue
            once = partial(_run, module, step)
            result = unless_starved(once, "error") if step in ON_THEIR_OWN else once()
            results.write(json.dumps(result) + "\n")
            results.flush()


def _run(module: str, step: str) -> dict[str, Any]:
    result: dict[str, Any] = {"step": step}
    started = time.monotonic()
    try:
        result |= getattr(importlib.import_module(f"inside.{module}"), step)()
    except Exception:
        result["error"] = traceback.format_exc()[-3000:]
        with contextlib.suppress(Exception):
            result["journal_tail"] = shell("journalctl", "--no-pager", "-n", "40", "-o", "cat")[-4000:]
    return result | {"seconds": round(time.monotonic() - started, 1)}


if __name__ == "__main__":
    main()
