"""A change of the gain set on an enabled axis that stands far from its reference: the joint goes there, never away."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servod.client.axis import ReferenceMotion
from servod.client.stepped import SteppedAxis
from servod.client.virtual import virtual_session
from servod.common.shipped import shipped
from servod.formats.gains.gain_set import load_gains
from servod.formats.model.axis_model import load_axis_model

SETS = ["demo_local_certified", "demo_local_stiff", "demo_local", "demo_pd_lugre", "demo_pd_dob"]


@pytest.mark.parametrize("name", SETS)
def test_the_joint_is_not_thrown(name: str, tmp_path: Path) -> None:
    """Friction holds the joint some 25 mrad behind under PD gains. An offset of torque alone threw it back by a tenth
    of a radian, or ended in SPEED_LIMIT."""
    session = virtual_session(load_axis_model(shipped("gains/axes/demo_joint.yaml")), tmp_path, 2**20, 1)
    axis = SteppedAxis(session, tmp_path)
    axis.activate(*axis.load(load_gains(shipped("gains/demo_pd.yaml"))))
    axis.enable()
    axis.run(ReferenceMotion.table((0.05 * np.linspace(0.0, 1.0, 500)).tolist()))
    axis.wait(1.0)
    standing = session.latest.reference_rad - session.latest.position_rad
    assert standing > 0.02
    session.clear()
    axis.activate(*axis.load(load_gains(shipped(f"gains/{name}.yaml"))))
    axis.wait(1.0)
    errors = [record.reference_rad - record.position_rad for record in session.records]
    assert max(errors) <= standing + 1e-4
    assert min(errors) > -1e-3 and abs(errors[-1]) < 2e-3
    assert max(abs(record.velocity_rad_s) for record in session.records) < 0.6
    axis.disable()
