"""The axis that a soak begins with: what ships, with noise of its own."""

from __future__ import annotations

from servod.campaign.scenario import Scenario


def nothing_yet(seed: int) -> Scenario:
    """The campaign's axis as it ships, with noise from `seed`; what a scenario injects is not used."""
    return Scenario.model_validate(
        {
            "title": "soak",
            "why": "Trust grows with hours.",
            "group": "soak",
            "settings": {"seed": seed},
            "inject": [{"do": {"frames": {"of": "any", "fault": "drop"}}}],
            "expect": {"axis": ["ENABLED"]},
        }
    )
