"""Every scenario of processes that ships passes with real ones: daemon, loop and virtual axis on the wall clock.

The deaths are tried with all other tests; the rest takes some minutes and stands with the long ones.
"""

import pytest

from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.qualify.faults.run import run_scenario
from servod.qualify.faults.scenario import Runs
from servod.qualify.faults.variants import shipped_scenarios

SCENARIOS = {name: s for name, s in shipped_scenarios().items() if s.runs is Runs.PROCESSES}

#: Scenarios without which no change may come in.
DEATHS = ("killed/", "killed_at_peak_torque/", "asked_to_end/", "two_daemons")


def named(name: str) -> object:
    """The scenario's name, marked as long unless it is one of the deaths."""
    return name if name.startswith(DEATHS) else pytest.param(name, marks=pytest.mark.long)


pytestmark = pytest.mark.serial


@pytest.mark.parametrize("name", [named(name) for name in SCENARIOS])
def test_the_scenario_ends_as_its_file_says(name: str) -> None:
    outcome = run_scenario(name, SCENARIOS[name])
    latched = [f"fault {code} (latched)" for code in outcome.detected]
    seen = "; ".join([*latched, *outcome.complaints])
    if FaultCode.DEADLINE_LATE.name in outcome.detected and "at the injection, not in operation enabled" in seen:
        raise Unreachable("DEADLINE_LATE: the axis had dropped before anything was injected")
    assert outcome.complaints == (), seen
