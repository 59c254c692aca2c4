"""The axis, cycle by cycle: every YAML file in tests/cycles is a scenario that someone who knows no Python can read.

Each entry is one cycle (or `repeat` of them): what happens (`ask`, `drive`, `faults`) and what the axis then shows.
"""

from pathlib import Path

import pytest

from servod.common.faults import FAULTS, FaultCode
from servod.common.yaml import parse_yaml
from servod.runtime.fieldbus.devices import AmplifierFeedback, DriveInput, DriveState, Mode, Reason
from servod.runtime.loop.axis import Axis
from servod.runtime.loop.axis_state import AxisState
from servod.runtime.loop.commands import Refusal

SCENARIOS = sorted((Path(__file__).parents[2] / "cycles").glob("*.yaml"))
PERIOD_S = 1e-3


def feedback(text: str) -> AmplifierFeedback:
    """`text`: a drive state, optionally followed by words: stale, warning, limit, remote, mode=N, "misses commands",
    estop, sto (the inputs), sto_told (by the drive's error code)."""
    name, *words = text.split()
    state = DriveState[name]
    mode = next((int(w[5:]) for w in words if w.startswith("mode=")), 10)
    status = (1 << 7 if "warning" in words else 0) | (1 << 11 if "limit" in words else 0)
    status |= 1 << 9 if "remote" in words else 0
    reached = state == DriveState.OPERATION_ENABLED
    reasons = Reason.IN_FAULT if state == DriveState.FAULT else Reason.NONE
    reasons |= Reason.COMMANDS_MISSED if "misses" in words else Reason.NONE
    inputs = sum(flag for flag in DriveInput if flag.name.lower() in words)
    return AmplifierFeedback(0, int("stale" in words), state, status, mode, 0.0, 0.0, 0, reached, reasons, inputs)


def ask(axis: Axis, request: str) -> Refusal | None:
    actions = {
        "enable": lambda: axis.enable(False),
        "enable with reset": lambda: axis.enable(True),
        "enable with proof": lambda: axis.enable(False, prove=True),
        "enable with proof and reset": lambda: axis.enable(True, prove=True),
        "tell it is proven": axis.proven,
        "disable": axis.disable,
        "quick stop": axis.quick_stop,
        "reset fault": axis.reset_fault,
    }
    return actions[request]()


def names(word: int) -> list[str]:
    return [c.name for c, f in FAULTS.items() if word & f.bit]


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda p: p.stem)
def test_scenario(path):
    document = parse_yaml(path.read_text(), path.name)
    times = (document.get("ramp_s", 0.003), document.get("enable_timeout_s", 0.01))
    axis = Axis(PERIOD_S, *times, Mode(10), 5.0, document.get("sto_known", False))
    drive = "SWITCH_ON_DISABLED"
    for number, entry in enumerate(document["cycles"], 1):
        drive = entry.get("drive", drive)
        if "ask" in entry:
            refusal = ask(axis, entry["ask"])
            assert (refusal or Refusal.DONE).name == entry.get("answer", "DONE"), f"{path.name}, entry {number}"
        bits = sum(FAULTS[FaultCode[name]].bit for name in entry.get("faults", []))
        for _ in range(entry.get("repeat", 1)):
            at_rest, moves = entry.get("reference at rest", False), entry.get("joint moves", False)
            output = axis.step(feedback(drive), "encoder stale" not in entry, bits, at_rest, moves)
        shown = {
            "axis": axis.state.name,
            "goal": axis.goal.name,
            "torque share": output.torque_share,
            "just enabled": output.just_enabled,
            "brake": output.brake,
            "reset": output.reset_fault,
            "present": names(axis.faults),
            "latched": names(axis.latched),
        }
        expected = entry["shows"]
        assert set(expected) <= set(shown), f"{path.name}, entry {number}: unknown key in shows"
        got = {key: shown[key] for key in expected}
        assert _same(got, expected), f"{path.name}, entry {number}: {got} != {expected}"


def _same(got: dict, expected: dict) -> bool:
    return all(got[k] == (pytest.approx(v) if isinstance(v, float) else v) for k, v in expected.items())


def test_there_are_scenarios():
    assert len(SCENARIOS) >= 8
    documents = [parse_yaml(path.read_text(), path.name) for path in SCENARIOS]
    told = {entry["shows"].get("axis") for document in documents for entry in document["cycles"]}
    assert told >= {state.name for state in AxisState} - {"RELEASING", "ENGAGING"}  # those of a brake


@pytest.mark.parametrize("code", [FaultCode.COMMANDS_LOST, FaultCode.DRIVE_STAYS_POWERED])
def test_a_drive_that_was_not_heard_before_it_was_brought_up_anew_is_heard_now(code):
    axis = Axis(PERIOD_S, 0.003, 0.01, Mode(10), 5.0)
    axis.carry(FAULTS[code].bit)
    axis.step(feedback("SWITCH_ON_DISABLED"), True, 0, True)
    assert not axis.unheard, "it would be stopped by NMT again, for ever"
    axis.note(FAULTS[code].bit)
    assert axis.unheard


def test_carried_fault_asks_for_a_reset_by_hand_and_for_a_restart_when_it_comes_again():
    bit = FAULTS[FaultCode.FOREIGN_SDO].bit
    for again in (False, True):
        axis = Axis(PERIOD_S, 0.003, 0.01, Mode(10), 5.0)
        axis.carry(bit)
        assert axis.state is AxisState.FAULT and axis.latched == bit
        assert axis.enable(False) == Refusal.FAULT_PRESENT
        if again:
            axis.note(bit)
        axis.step(feedback("SWITCH_ON_DISABLED"), True, 0, True)
        assert axis.latched == bit
        assert axis.enable(True) == (Refusal.NEEDS_RESTART if again else Refusal.DONE)
