"""The axis that a soak begins with: what ships, with noise of its own."""

from __future__ import annotations

from servod.qualify.faults.scenario import Scenario


def nothing_yet(seed: int, proves: bool) -> Scenario:
    """The campaign's axis as it ships, with noise from `seed`; what a scenario injects is not used.

    `proves`: it proves its wiring after every start, as it ships; a scenario's axis does not.
    """
    return Scenario.model_validate(
        {
            "title": "soak",
            "why": "Trust grows with hours.",
            "group": "soak",
            "settings": {"seed": seed},
            "config": {"wiring_proof": {"enabled": proves}},
            "inject": [{"do": {"frames": {"of": "any", "fault": "drop"}}}],
            "expect": {"axis": ["ENABLED"]},
        }
    )
