"""The process that diagnoses: on the very command, resumable, and gone at once when it is interrupted."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.common.sources import DIAGNOSES, sha256_on_disk
from servod.qualify.blind.conceal import CASES, SEALED, TRUTH, BlindTrial, make_case, write_case, write_trial
from servod.qualify.blind.examine import ANSWERS, RUN, SAID, Examiner
from servod.qualify.blind.plan import Settings, plans


def short_case(out: Path, name: str) -> None:
    """A case whose recordings are so short that the diagnosis refuses them at once."""
    case = make_case(plans(5, 1, Settings())[0], Settings())
    for columns in case.recordings.values():
        for column, values in columns.items():
            columns[column] = np.asarray(values[:40])
    write_case(case, out / CASES / name, out / "held" / name)


def test_what_is_done_is_not_done_again(tmp_path: Path) -> None:
    for name in ("c000", "c001"):
        short_case(tmp_path, name)
    kept = tmp_path / ANSWERS / "c000" / RUN
    kept.parent.mkdir(parents=True)
    done = json.dumps({"exit_code": 0, "sources": sha256_on_disk(DIAGNOSES)})
    kept.write_text(done)
    sealed = tmp_path / SEALED / TRUTH
    sealed.parent.mkdir()
    sealed.write_text("{}")
    told: list[tuple[str, int, int]] = []
    Examiner(tmp_path, 5.0).run(1, lambda name, done, of: told.append((name, done, of)))
    assert told == [("c001", 2, 2)]
    assert kept.read_text() == done
    assert sealed.stat().st_mode & 0o777 == 0
    run = json.loads((tmp_path / ANSWERS / "c001" / RUN).read_text())
    assert run["exit_code"] == 1 and run["sources"] == sha256_on_disk(DIAGNOSES)
    assert run["cpu_s"] > 0.1 and run["memory_mib"] > 10.0
    assert "These data cannot tell" in (tmp_path / ANSWERS / "c001" / SAID).read_text()


@pytest.mark.parametrize("run", [{"exit_code": 0}, {"exit_code": 0, "sources": "ab" * 32}], ids=["unknown", "other"])
def test_a_trial_does_not_go_on_with_other_sources(tmp_path: Path, run: dict[str, object]) -> None:
    for name in ("c000", "c001"):
        (tmp_path / CASES / name).mkdir(parents=True)
    kept = tmp_path / ANSWERS / "c000" / RUN
    kept.parent.mkdir(parents=True)
    kept.write_text(json.dumps(run))
    with pytest.raises(BadInput, match="to diagnose all cases again"):
        Examiner(tmp_path, 5.0).run(1, lambda _name, _done, _of: None)
    assert not (tmp_path / ANSWERS / "c001").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_what_runs_and_keeps_nothing_half_done(tmp_path: Path, number: signal.Signals) -> None:
    case = make_case(plans(5, 1, Settings())[0], Settings())
    write_case(case, tmp_path / CASES / "c000", tmp_path / "held")
    write_trial(tmp_path, BlindTrial(1, 1, False, sha256="0" * 64))
    command = [sys.executable, "-m", "servod.cli", "prove", "--only", "diagnose", "--out", str(tmp_path)]
    trial = subprocess.Popen(command, stderr=subprocess.PIPE)
    said = tmp_path / ANSWERS / "c000" / SAID
    while not (said.exists() and said.read_text()):
        assert trial.poll() is None
        time.sleep(0.05)
    children = Path(f"/proc/{trial.pid}/task").glob("*/children")
    running = [int(pid) for file in children for pid in file.read_text().split()]
    assert len(running) == 1
    os.kill(trial.pid, number)
    _, error = trial.communicate(timeout=30)
    assert trial.returncode == 130, error
    assert not (tmp_path / ANSWERS / "c000" / RUN).exists()
    assert not Path(f"/proc/{running[0]}").exists()
