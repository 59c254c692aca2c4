"""The axis model file: the full example, models that omit things, and one line for every mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from servod.common.errors import BadInput
from servod.common.yaml import load_model, parse_yaml, validate
from servod.formats.model.axis_model import AxisModel, load_axis_model
from servod.formats.model.keys import Harmonics

HERE = Path(__file__).parent
AXES = sorted((HERE.parents[2] / "gains" / "axes").glob("*.yaml"))
MISTAKES = parse_yaml((HERE / "bad_models.yaml").read_text(), "bad_models.yaml")
GOOD: dict[str, Any] = {
    "inertia": 0.001,
    "friction": {"kind": "lugre", "sigma0": 950.0, "viscous": 0.056, "coulomb": 0.045},
}


@pytest.mark.parametrize("mistake", MISTAKES, ids=[str(m["names"]) for m in MISTAKES])
def test_a_mistake_is_named(mistake: dict[str, Any]) -> None:
    with pytest.raises(BadInput) as error:
        validate({**GOOD, **mistake["change"]}, AxisModel, "plant.yaml")
    line = str(error.value)
    assert line.startswith("plant.yaml") and "\n" not in line
    for name in mistake["names"]:
        assert str(name) in line


@pytest.mark.parametrize("path", AXES, ids=lambda path: path.stem)
def test_shipped_axes_load_and_come_back(path: Path, tmp_path: Path) -> None:
    model = load_axis_model(path)
    copy = tmp_path / "copy.yaml"
    copy.write_text(yaml.safe_dump(model.model_dump(mode="json", exclude_none=True)))
    assert load_axis_model(copy) == model


def test_table_one_is_the_papers() -> None:
    model = load_axis_model(HERE.parents[2] / "gains" / "axes" / "table1_joint.yaml")
    friction = model.friction
    assert friction.kind == "lugre"
    printed = (friction.static, friction.coulomb, friction.viscous, friction.stribeck_velocity)
    assert printed == (0.07, 0.045, 0.056, 0.1)
    assert (friction.sigma0, friction.sigma1, model.inertia) == (950.0, 1.0, 0.001)


def test_a_model_may_omit_what_it_does_not_have(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text(
        "inertia: 9511e-2\naxis: linear\nfriction: {kind: coulomb_viscous, viscous: 203.5, coulomb: 20.39}\n"
    )
    model = load_model(path, AxisModel)
    assert (model.inertia, model.total_delay_s, model.torque_offset) == (95.11, 0.001, 0.0)
    assert len(model.pack().p) > 70


class Toy(Harmonics):
    """A group that no list knows."""

    under_one = 0


class WithToy(AxisModel):
    """An axis model with one group more."""

    toy: Toy | None = None


def test_a_new_group_is_checked_and_packed_by_what_its_record_says(monkeypatch: pytest.MonkeyPatch) -> None:
    wave = {"amplitude": 0.6, "periods_per_turn": 3.0}
    without, beside = (validate({**GOOD, **more}, WithToy, "toy") for more in ({}, {"toy": {"harmonics": [wave]}}))
    assert [name for name, _ in beside.groups()] == ["toy"]
    plain, full = without.pack(), beside.pack()
    assert [b - a for a, b in zip(plain.p, full.p, strict=True) if a != b] == [
        1.0
    ]  # the full loop runs, as for all that is not plain
    monkeypatch.setattr(Toy, "plain", True)
    assert beside.pack() == without.pack()
    for rows, word in (([wave, wave], "amplitudes that sum"), ([{"amplitude": 0.1, "periods_per_metre": 3.0}], "no ")):
        with pytest.raises(BadInput, match=f"toy: {word}"):
            validate({**GOOD, "toy": {"harmonics": rows}}, WithToy, "toy")
