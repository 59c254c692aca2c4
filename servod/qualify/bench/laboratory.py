"""How long the laboratory takes: synthesis of both regions, a certificate, and a whole commissioning.

Beside the figures of the loop; each on Table I's joint, the axis model that ships.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from typing import Any

from servod.common.shipped import shipped

PROCESSES = 2


def measure(plants: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Seconds of a synthesis, imports not counted, and of a verification with `plants` simulated plants."""
    from servod.common.errors import AnswerIsNo
    from servod.formats.gains.gain_set import GainSet
    from servod.formats.model.axis_model import load_axis_model
    from servod.lab.synthesize.gain_set import synthesize
    from servod.lab.verify.certify import verify

    path = shipped("gains/axes/table1_joint.yaml")
    started = time.perf_counter()
    gains = synthesize(load_axis_model(path), model_path=path)
    synthesis_s = time.perf_counter() - started
    if not isinstance(gains, GainSet):
        raise AnswerIsNo(f"benchmark: no design for {path}: {'; '.join(gains.clashes)}")
    started = time.perf_counter()
    valid = verify(gains, plants, processes=PROCESSES, least_plants=plants).valid
    verification = {"seconds": time.perf_counter() - started, "plants": plants, "valid": valid}
    return {"seconds": synthesis_s}, verification


def commission() -> dict[str, Any]:
    """Seconds of `servoctl commission` on the virtual axis, from its start to its end, and of each step."""
    plant = shipped("gains/axes/table1_joint.yaml")
    with tempfile.TemporaryDirectory(prefix="servod-bench-") as folder:
        command = [sys.executable, "-m", "servod.cli", "commission", "--plant", str(plant), "--out", folder, "--json"]
        started = time.perf_counter()
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True)
        return {"seconds": time.perf_counter() - started, "steps": json.loads(done.stdout)["seconds"]}
