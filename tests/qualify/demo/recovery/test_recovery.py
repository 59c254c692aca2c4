"""The whole story on a small scale: what a concealed effect cost comes back, from the axis's own recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from servod.client.open import stepped_axis
from servod.common.shipped import shipped
from servod.formats.model.axis_model import load_axis_model
from servod.qualify.demo.recovery.walk import SCALES, Effort, believed_and_true, recover, write_recovery_page

EFFORT = Effort(paper_s=8.0, diagnosed_s=8.0, motion_s=6.0, plants=20)


@pytest.mark.long
@pytest.mark.timeout(600)
def test_what_a_concealed_effect_cost_comes_back(tmp_path: Path) -> None:
    believed, true = believed_and_true(load_axis_model(shipped("gains/axes/table1_joint.yaml")), "gravity")
    told: list[str] = []
    found = recover(
        believed, true, "gravity", stepped_axis, tmp_path, lambda what, _share: told.append(what), effort=EFFORT
    )
    write_recovery_page(found, tmp_path)
    document = found.summary()
    assert [finding["effect"] for finding in document["findings"]] == ["gravity"]
    assert document["rms_error_mrad"]["concealed"] > 1.5 * document["rms_error_mrad"]["before"]
    assert document["recovered_share"] >= 0.8
    assert document["deployment"]["deployed"]
    assert document["deployment"]["before"]["slow_mrad"] > document["promised_before"]["slow_mrad"]
    assert {path.name for path in (tmp_path / "recordings").iterdir()} == {
        f"{name}.mcap" for name in ("paper", "slow_sine", "multisine", "moves")
    }
    assert document["uncertainty_scale"]["before"] == 1.0
    assert document["uncertainty_scale"]["after"] in SCALES
    assert any("the certificate promised" in line for line in document["broken_promises"])
    page = (tmp_path / "report.html").read_text()
    assert "of what the concealed effect cost is back" in page
    assert (tmp_path / "diagnosis" / "report.html").exists()
    assert told[0] == "design for what is believed"
