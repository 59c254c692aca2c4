"""What surrounds a command: folders with long names, and a shell that told it to go on when the terminal closes."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from servod.client.processes import socket_folder

HUNG_UP = """
import os, signal
from servod.client.processes import sigterm_as_interrupt
with sigterm_as_interrupt():
    os.kill(os.getpid(), signal.SIGHUP)
    print("went on")
"""


def test_sockets_find_room_where_the_temporary_folder_is_deep(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(deep))
    with socket_folder("servod-tried-") as folder, socket.socket(socket.AF_UNIX) as listening:
        assert Path(folder).stat().st_mode & 0o777 == 0o700
        listening.bind(f"{folder}/axis.sock")
    assert not Path(folder).exists()


def test_a_short_temporary_folder_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp") as short:
        monkeypatch.setattr(tempfile, "tempdir", short)
        with socket_folder("servod-tried-") as folder:
            assert Path(folder).parent == Path(short)


@pytest.mark.parametrize(("ignored", "code", "said"), [(True, 0, "went on\n"), (False, -signal.SIGINT, "")])
def test_a_closed_terminal_ends_a_command_unless_it_was_to_go_on(ignored: bool, code: int, said: str) -> None:
    """`nohup servoctl ... &` is how a soak of a night is begun."""
    as_nohup = signal.SIG_IGN if ignored else lambda *_: None  # a handler is not inherited
    before = signal.signal(signal.SIGHUP, as_nohup)
    try:
        done = subprocess.run([sys.executable, "-c", HUNG_UP], capture_output=True, text=True, timeout=30)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert (done.returncode, done.stdout) == (code, said)


EARLY = """
import sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == "typer":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
import servod.cli
servod.cli.main()
"""


def test_ctrl_c_while_the_program_is_being_loaded_is_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", EARLY], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
