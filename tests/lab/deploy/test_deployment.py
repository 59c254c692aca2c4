"""Trials on the stepped axis: what stays, what goes and why; an interrupt leaves the old set and a safe axis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servod.client.axis import LOOK_S, ReferenceMotion, Watch
from servod.client.control import Refused
from servod.client.stepped import SteppedAxis
from servod.client.virtual import axis_for_set, with_cutoff
from servod.common.errors import AnswerIsNo, BadInput, ServodError
from servod.common.faults import FAULTS, FaultCode
from servod.formats.gains.gain_set import pd_set
from servod.formats.gains.store import Action, GainStore
from servod.formats.model.axis_model import AxisModel
from servod.lab.deploy.deployment import deploy, interrupted, run_validation
from servod.lab.deploy.judge import limits_met, motions_in
from servod.lab.deploy.outcome import Baseline, Ending
from servod.lab.recordings.recording import ROW, Rows
from servod.lab.verify.plants import scaled
from servod.lab.verify.validation import motion_for
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Op
from tests.lab.deploy.sets import certified_in_short as certified
from tests.lab.deploy.sets import shorten_validation
from tests.lab.synthesize.designs import table1

PD = pd_set("present", 2.5, 0.12)


@pytest.fixture(autouse=True)
def in_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every trial of this file; the motion in its full length is that of tests/lab/commission."""
    shorten_validation(monkeypatch)


def axis_of(plant: AxisModel, folder: Path) -> SteppedAxis:
    return axis_for_set(plant, folder, certified(), PD)


def quiet(_what: str, _share: float) -> None:
    """Nobody listens."""


def test_a_good_set_stays_and_is_compared_with_what_was_before_also_once_it_runs(tmp_path: Path) -> None:
    axis = axis_of(table1(), tmp_path)
    told: list[Baseline] = []
    done = deploy(axis, certified(), quiet, remember=told.append)
    assert done.proven, done.reasons
    assert axis.active == (certified().name, 1) and done.ending is Ending.KEPT
    assert done.ran_before is told[0] and told[0].present == ("present", 1)
    entry = GainStore(tmp_path / "gains").history()[-1]
    assert (entry.action, entry.name) == (Action.ACTIVATE, certified().name)
    assert entry.figures["after_slow_mrad"] < 0.2 * entry.figures["before_slow_mrad"]
    assert axis.session.cycle.axis.state == AxisState.DISABLED  # as it was found
    again = deploy(axis, certified(), quiet, *told, told.append)
    assert again.ending is Ending.CONFIRMED and len(told) == 1
    assert (again.before, again.document()["present"]) == (done.before, {"name": "present", "version": 1})
    assert GainStore(tmp_path / "gains").rollback().name == "present"


@pytest.mark.parametrize("change", [{"dry": 2.0, "viscous": 2.0}, {"inertia": 2.0}], ids=["friction", "inertia"])
def test_a_set_for_another_joint_is_rolled_back(change: dict[str, float], tmp_path: Path) -> None:
    axis = axis_of(scaled(table1(), change), tmp_path)
    done = deploy(axis, certified(), quiet)
    assert not done.proven and done.said.startswith("rolled back to present version 1: ")
    assert any("promised" in reason for reason in done.reasons)
    store = GainStore(tmp_path / "gains")
    active = store.active()
    assert axis.active == ("present", 1)
    assert active is not None and active.name == "present"
    entry = store.history()[-1]
    assert (entry.action, entry.name) == (Action.REJECT, certified().name)
    assert "promised" in entry.note


@pytest.mark.parametrize("refusal", [AnswerIsNo("the store is full"), Refused("refused: a motion is running")])
def test_a_set_that_is_not_activated_says_why(
    refusal: ServodError, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is on trial then; giving it up would only be refused, and hide the reason."""

    def refused(*_: object) -> None:
        raise refusal

    axis = axis_of(table1(), tmp_path)
    monkeypatch.setattr(axis, "activate", refused)
    monkeypatch.setattr(axis, "give_up", lambda *_: pytest.fail("nothing is on trial"))
    if isinstance(refusal, AnswerIsNo):
        done = deploy(axis, certified(), quiet)
        assert not done.proven and done.reasons == (str(refusal),)
    else:
        with pytest.raises(Refused, match="a motion is running"):
            deploy(axis, certified(), quiet)


def test_a_limit_that_is_met_rolls_back(tmp_path: Path) -> None:
    limits = axis_of(table1(), tmp_path / "roomy").config.limits.model_copy(update={"torque_nm": 0.075})
    config = axis_of(table1(), tmp_path).config
    proof = config.wiring_proof.model_copy(update={"torque_nm": 0.075})  # just above break-away
    config = config.model_copy(update={"limits": limits, "wiring_proof": proof})
    axis = axis_for_set(table1(), tmp_path, certified(), PD, config=config)
    with pytest.raises(BadInput, match=r"certificate\.torque_nm: .* at most 0\.075"):
        deploy(axis, certified(), quiet)
    earlier = certified().certificate.model_copy(update={"torque_nm": None})  # issued before torque was stated
    done = deploy(axis, certified().model_copy(update={"certificate": earlier}).sealed(), quiet)
    assert not done.proven and any(reason.startswith("TORQUE_CLIPPED") for reason in done.reasons)


def test_few_limited_cycles_and_those_that_the_set_before_met_as_well_are_not_held_against_a_set() -> None:
    def limited(cycles: int) -> Rows:
        rows = np.zeros(10_000, dtype=ROW)
        rows["faults"][:cycles] = FAULTS[FaultCode.TORQUE_CLIPPED].bit
        return rows

    assert limits_met(limited(15), limited(0)) == []
    assert limits_met(limited(300), limited(200)) == []
    assert limits_met(limited(500), limited(450)) == []
    assert limits_met(limited(6000), limited(6000)) == []
    for more, before in ((10_000, 5000), (6001, 6000), (501, 450), (301, 200), (60, 25), (25, 0)):
        assert limits_met(limited(more), limited(before))
    (said,) = limits_met(limited(300), limited(100))
    assert said.startswith("TORQUE_CLIPPED in 3 % of the cycles")


def test_a_set_that_loses_the_joint_on_a_sine_is_given_no_step(tmp_path: Path) -> None:
    axis = axis_of(scaled(table1(), {"dry": 3.0, "viscous": 3.0}), tmp_path)
    axis.enable()
    motion = motion_for(certified().design or pytest.fail("designed"))
    rows = run_validation(axis, motion, 2e-4)
    (sines,) = motions_in(rows)
    assert len(sines) < len(motion.sines) and interrupted(rows, motion)
    assert np.ptp(sines["reference_rad"]) < motion.travel_rad
    assert len(motions_in(run_validation(axis, motion, 0.4))) == 3


class Narrow(SteppedAxis):
    """An axis whose window is too narrow for any set but the present one."""

    def run(
        self,
        motion: ReferenceMotion,
        watch: Watch | None = None,
        look_s: float = LOOK_S,
        each_cycle: Watch | None = None,
    ) -> bytes:
        if self.active[0] != PD.name and "window_rad" in motion.arguments:
            motion = ReferenceMotion(motion.arguments | {"window_rad": 1e-5})
        return super().run(motion, watch, look_s, each_cycle)


def test_a_cut_sine_rolls_back(tmp_path: Path) -> None:
    axis = Narrow(axis_of(table1(), tmp_path).session, tmp_path, PD)
    done = deploy(axis, certified(), quiet)
    assert not done.proven and done.after is None and "window" in done.reasons[0]
    assert done.rows_after is not None and len(motions_in(done.rows_after)) == 1
    assert axis.active == ("present", 1)


def test_a_set_that_runs_already_and_fails_is_never_said_to_be_rolled_back(tmp_path: Path) -> None:
    session = axis_for_set(table1(), tmp_path, certified(), certified()).session
    axis = Narrow(session, tmp_path, certified())
    done = deploy(axis, certified(), quiet)
    assert (done.ending, done.before, done.document()["present"]) == (Ending.DOUBTED, None, None)
    assert "STILL RUNS" in done.said and "rolled back" not in done.said and "window" in done.said
    assert axis.active == (certified().name, 1)
    assert [h.action for h in GainStore(tmp_path / "gains").history()] == [Action.LOAD, Action.ACTIVATE]


@pytest.mark.parametrize("when", [("change of the set", 0.48), ("under the new set", 0.52)])
def test_a_fault_under_the_new_set_rolls_back_and_is_not_reset(when: tuple[str, float], tmp_path: Path) -> None:
    axis = axis_of(table1(), tmp_path)

    def drop_out(what: str, share: float) -> None:
        if (what, share) == when:
            axis.session.send(Op.NODE_EVENT, [FaultCode.DRIVE_RESET])

    done = deploy(axis, certified(), drop_out)
    assert not done.proven and done.after is None and axis.active == ("present", 1)
    assert done.reasons[0].startswith("the axis went to FAULT")
    assert axis.session.cycle.axis.state == AxisState.FAULT


@pytest.mark.parametrize("when", ["under the present set", "under the new set"])
def test_an_interrupt_leaves_the_old_set_active_and_the_axis_off(when: str, tmp_path: Path) -> None:
    axis = axis_of(table1(), tmp_path)

    def interrupt(what: str, share: float) -> None:
        if what == when and share % 0.45 > 0.2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        deploy(axis, certified(), interrupt)
    assert axis.active == ("present", 1)
    axis.session.run(1.0)
    assert axis.session.cycle.axis.state == AxisState.DISABLED
    assert abs(axis.session.world.truth().velocity_rad_s) < 1e-3
    assert axis.session.latest.torque_nm == 0.0


def test_a_set_without_certificate_and_one_for_another_filter_are_refused_before_anything_moves(tmp_path: Path) -> None:
    axis = axis_of(table1(), tmp_path)
    with pytest.raises(BadInput, match="certificate"):
        deploy(axis, PD, quiet)
    promised_nothing = certified().certificate.model_copy(update={"promised": None})
    with pytest.raises(BadInput, match="promised"):
        deploy(axis, certified().model_copy(update={"certificate": promised_nothing}).sealed(), quiet)
    axis.session.config = with_cutoff(axis.config, 77.0)
    with pytest.raises(BadInput, match="velocity_cutoff_hz"):
        deploy(axis, certified(), quiet)
    assert axis.session.cycle.axis.state == AxisState.DISABLED
