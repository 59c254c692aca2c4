"""Axes whose torque comes late: with more cycles than the law feeds back there is a design or a plain refusal."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.cli.app import run
from servod.lab.synthesize.deployed import Wishes, bare_proof, empty_design, programme
from servod.lab.synthesize.gain_set import synthesize
from servod.lab.synthesize.infeasible import Infeasible
from servod.lab.verify.sampled import SampledTiming
from servod.lab.verify.vertices import fed_commands, known_commands
from tests.lab.synthesize.designs import MODEL, table1


@pytest.mark.parametrize(
    ("cycles", "fed", "known"), [(0.0, 1, 1), (1.0, 2, 2), (2.0, 3, 3), (5.0, 3, 5), (20.0, 3, 20)]
)
def test_every_command_on_its_way_is_a_state(cycles: float, fed: int, known: int) -> None:
    timing = SampledTiming(0.001, 0.001 * cycles, 300.0)
    assert (fed_commands(timing), known_commands(timing)) == (fed, known)
    late = table1().model_copy(update={"delay_s": 0.001 * cycles})
    design = empty_design(late, Wishes(), 300.0)
    frame = bare_proof(design, Wishes().spans[1], Wishes())
    assert len(frame.scale) == 4 + known == programme(design, frame, Wishes()).a.shape[-1]


def test_twenty_cycles_of_delay_are_refused_with_what_would_help() -> None:
    found = synthesize(table1().model_copy(update={"delay_s": 0.02}))
    assert isinstance(found, Infeasible) and found.relaxations == ()
    assert found.regions == ("low", "high")
    assert "20 cycles" in found.clashes[0] and "a cycle of 4 ms" in found.clashes[0]


def test_the_command_says_so_and_exits_with_no(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "gains.yaml"
    assert run(["synthesize", "--model", str(MODEL), "--out", str(out), "--delay-s", "0.02"]) == 1
    assert not out.exists()
    assert "too much delay: 20 ms are 20 cycles" in capsys.readouterr().out
