"""The bus: the conformance suite on vcan0, and can-utils as an independent party beside the running axis."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from inside.tools import INTERFACE, client, shell


def conformance() -> dict[str, Any]:
    """tests/conformance, as on every other bus; only those of its tests that open one are told apart by it."""
    tests = Path(sys.argv[1]) / "tests" / "conformance"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", INTERFACE, str(tests)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    return {"exit_code": done.returncode, "said": done.stdout.strip()[-1500:]}


def witness() -> dict[str, Any]:
    """candump(1) sees what the two sides say to each other while the axis moves, and its frames are well formed."""
    with client() as connection:
        connection.call("enable")
        connection.call("track", kind="sine", amplitude_rad=0.2, frequency_hz=0.5, duration_s=30.0)
        dumped = shell("candump", "-L", "-n", "400", "-T", "3000", INTERFACE, check=False)
        connection.call("disable")
    frames = re.findall(r"\) \w+ ([0-9A-F]{3})#([0-9A-F]*)", dumped)
    counts = Counter(can_id for can_id, _ in frames)
    lengths = {can_id: sorted({len(data) // 2 for seen, data in frames if seen == can_id}) for can_id in counts}
    return {"counts": dict(counts), "lengths": lengths}
