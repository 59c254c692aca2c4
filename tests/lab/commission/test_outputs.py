"""What the steps count as theirs: every set that is compared and every run that is read again, not their list alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.common.errors import BadInput
from servod.lab.commission.comparison import DEPLOYED, run_files
from servod.lab.commission.state import TRACKING, TUNING, State, write_text
from servod.lab.commission.steps.rivals import Rivals, contenders, rival_file
from servod.lab.commission.steps.validate import Validate
from servod.lab.commission.walk import Step, Walk
from tests.lab.commission.test_state import AXIS, walk


def recorded(step: Step, here: Walk) -> State:
    """The state of a walk in which this step alone is done."""
    state = State(here.folder, AXIS.identity, [])
    state.record(step.name, {}, 1.0, step.outputs(here))
    return state


def test_a_rival_that_was_edited_is_not_compared_in_silence(tmp_path: Path) -> None:
    here, rivals = walk(tmp_path), Rivals()
    files = [rival_file(here, *who) for who in contenders()]
    for file in (here.path(TUNING), *files):
        write_text(file, "as tuned\n")
    state = recorded(rivals, here)
    assert len(files) == 8 and state.done(rivals.name, {}, rivals.outputs(here))
    files[3].write_text("by hand\n")
    with pytest.raises(BadInput, match=rf"rivals/{files[3].name}.*--again rivals"):
        state.done(rivals.name, {}, rivals.outputs(here))
    files[3].unlink()
    assert not state.done(rivals.name, {}, rivals.outputs(here))


def test_without_a_comparison_there_is_no_rival(tmp_path: Path) -> None:
    assert Rivals().outputs(walk(tmp_path, rivals=False)) == (TUNING,)


def test_a_run_that_was_edited_or_is_gone_is_not_read_in_silence(tmp_path: Path) -> None:
    here, validate = walk(tmp_path), Validate()
    figures, curves = run_files(here, DEPLOYED)
    for file in (here.path(TRACKING), figures, curves):
        write_text(file, "as measured\n")
    state = recorded(validate, here)
    assert state.done(validate.name, {}, validate.outputs(here))
    curves.unlink()
    assert not state.done(validate.name, {}, validate.outputs(here))
    figures.write_text("by hand\n")
    with pytest.raises(BadInput, match=rf"runs/{figures.name}.*--again validate"):
        state.done(validate.name, {}, validate.outputs(here))
