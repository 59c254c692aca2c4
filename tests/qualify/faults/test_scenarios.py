"""Every scenario that ships passes on the axis under test that shows it in virtual time."""

import pytest

from servod.qualify.faults.run import run_scenario
from servod.qualify.faults.scenario import Runs
from servod.qualify.faults.variants import shipped_scenarios

SCENARIOS = {name: s for name, s in shipped_scenarios().items() if s.runs is Runs.STEPPED}


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_scenario_ends_as_its_file_says(name):
    assert run_scenario(name, SCENARIOS[name]).complaints == ()
