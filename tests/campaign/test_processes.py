"""Every scenario of processes that ships passes with real ones: daemon, loop and virtual axis on the wall clock."""

import pytest

from servod.campaign.catalogue import shipped_scenarios
from servod.campaign.run import run_scenario
from servod.campaign.scenario import Runs

SCENARIOS = {name: s for name, s in shipped_scenarios().items() if s.runs is Runs.PROCESSES}

pytestmark = pytest.mark.serial


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_scenario_ends_as_its_file_says(name: str) -> None:
    assert run_scenario(name, SCENARIOS[name]).complaints == ()
