"""`servoctl demo --diagnose`: the story of an effect that was concealed, from its cost to its cure, in one command."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from servod.cli.common import need_folder, one_thread, print_json, progress
from servod.common.errors import AnswerIsNo

#: Share of the cost that must come back.
LEAST_RECOVERED = 0.8


def demo_diagnose(plant: Path, effect: str, fast: bool, out: Path, as_json: bool) -> None:
    """Run the story on `plant` and print it. Raises AnswerIsNo when less than LEAST_RECOVERED comes back."""
    one_thread()
    from servod.client.open import daemon_axis, stepped_axis
    from servod.client.processes import sigterm_as_interrupt
    from servod.formats.model.axis_model import load_rotary_model
    from servod.qualify.demo.recovery.concealed import believed_and_true
    from servod.qualify.demo.recovery.page import write_recovery_page
    from servod.qualify.demo.recovery.walk import recover

    believed, true = believed_and_true(load_rotary_model(plant), effect)
    need_folder("--out", out)
    begun = time.monotonic()
    with sigterm_as_interrupt(), progress("demo --diagnose", quiet=as_json) as tell:
        found = recover(believed, true, effect, stepped_axis if fast else daemon_axis, out, tell)
    report = write_recovery_page(found, out)
    document = found.summary() | {
        "mode": "stepped" if fast else "wall",
        "wall_s": time.monotonic() - begun,
        "report": str(report),
    }
    if as_json:
        print_json(document)
    else:
        _print(document)
    if document["recovered_share"] < LEAST_RECOVERED:
        share = f"{100.0 * document['recovered_share']:.0f} % of what {effect} cost came back"
        raise AnswerIsNo(f"{share}, at least {100.0 * LEAST_RECOVERED:.0f} % should")


def _print(document: dict[str, Any]) -> None:
    rms = document["rms_error_mrad"]
    found = ", ".join(f"{f['effect']} ({f['confidence']:.2f})" for f in document["findings"]) or document["verdict"]
    from servod.qualify.demo.recovery.walk import within

    share = {key: f"certified {within(scale)}" for key, scale in document["uncertainty_scale"].items()}
    print(f"as believed         {rms['before']:.4f} mrad RMS on trajectory (19), {share['before']}")
    print(f"{document['concealed']} concealed   {rms['concealed']:.4f} mrad")
    for line in document["broken_promises"]:
        print(f"promise broken: {line}")
    print(f"diagnosed: {found}")
    if not document["deployment"]["deployed"]:
        print(f"rolled back: {'; '.join(document['deployment']['reasons'])}")
    back = f"{100.0 * document['recovered_share']:.0f} % of the cost is back"
    print(f"after new design    {rms['after']:.4f} mrad, {share['after']}: {back}")
    print(f"Report: {document['report']}")
