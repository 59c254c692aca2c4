"""Every scenario that ships passes on the axis under test that shows it in virtual time."""

import pytest

from servod.client.stepped import SteppedSession
from servod.qualify.faults.run import run_scenario
from servod.qualify.faults.scenario import Runs
from servod.qualify.faults.variants import shipped_scenarios

SCENARIOS = {name: s for name, s in shipped_scenarios().items() if s.runs is Runs.STEPPED}


@pytest.mark.parametrize("polled_before", range(0, 20, 4))
def test_a_drive_that_stays_powered_is_told_to_stop_whenever_the_supervisor_looks(polled_before, monkeypatch, caplog):
    """The loop has just put it into NMT stopped, where it answers no SDO, and the load hangs on it."""
    begin = SteppedSession.__init__

    def begin_between_polls(session, *arguments, **options):
        begin(session, *arguments, **options)
        session._cycles_until_poll = polled_before

    monkeypatch.setattr(SteppedSession, "__init__", begin_between_polls)
    name = "held_load/SYNC lost"
    assert run_scenario(name, SCENARIOS[name]).complaints == ()
    assert "did not take a quick stop" not in caplog.text


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_scenario_ends_as_its_file_says(name):
    assert run_scenario(name, SCENARIOS[name]).complaints == ()
