"""What a parent leaves to the daemon of its own signals does not hold there."""

from __future__ import annotations

import signal
import subprocess
import sys

#: As a parent that ignores its children's end and blocks signals starts it; then what the daemon sees of a child.
INHERITED = """
import signal, subprocess, sys
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
from servod.runtime.daemon.main import main
main(["--config", "missing.yaml", "--check"])
child = subprocess.Popen([sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"])
blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
print(child.wait(), sorted({signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGALRM} & blocked))
"""


def test_a_killed_child_has_not_ended_well_and_end_signals_arrive() -> None:
    done = subprocess.run([sys.executable, "-c", INHERITED], capture_output=True, text=True)
    assert done.stdout == f"{-signal.SIGKILL} []\n", done.stderr
