"""The label of a row says what the row holds: law, gains and options of its set."""

from __future__ import annotations

import re

import pytest

from servod.formats.gains.gain_set import GainSet
from servod.formats.gains.parameters import (
    LocalParameters,
    PdDobParameters,
    PdLugreParameters,
    PdParameters,
    RegionGains,
)
from servod.qualify.paper.joints import shipped_set
from servod.qualify.paper.printed import GAINS_HIGH, GAINS_LOW, K_D, K_P, L_I
from servod.qualify.paper.results import Row
from servod.qualify.paper.walk import PLAIN_L, designed_sets, paper_sets

#: A synthesized set with every option that synthesis gives.
DESIGNED = shipped_set("demo_local_certified")
SETS = paper_sets() | designed_sets(DESIGNED)
#: Keys of the local law beside (9), (13) and (16).
OPTIONS = {
    *("disturbance_observer", "feedforward_inertia_kg_m2", "hold_within_rad", "error_limit_rad"),
    *("rest_within_rad", "rest_share", "position_feedforward"),
}
LAWS = {"PD": PdParameters, "PD + DOB": PdDobParameters, "PD + LuGre": PdLugreParameters, "local": LocalParameters}


def options_of(gains: GainSet) -> set[str]:
    return {key for key in OPTIONS if getattr(gains.parameters, key)}


def test_every_row_has_its_set() -> None:
    assert set(SETS) == set(Row)
    assert options_of(DESIGNED) == OPTIONS


@pytest.mark.parametrize("row", Row, ids=lambda row: row.name.lower())
def test_the_label_says_the_law_and_its_options(row: Row) -> None:
    law, label = SETS[row].parameters, row.label
    name = re.split(", | at | as ", label)[0].replace("Table I", "local")
    assert type(law) is LAWS[name]
    if isinstance(law, PdDobParameters):
        assert f", {law.bandwidth_rad_s:g} rad/s" in label
    if isinstance(law, PdLugreParameters):
        assert label.endswith(f", l_f {law.observer_gain:g}")
    if isinstance(law, LocalParameters):
        assert "no options" not in label or not options_of(SETS[row])
        assert "all options" not in label or options_of(SETS[row]) == OPTIONS
        if "velocity" in label:
            assert f", {law.friction.velocity.value.replace('_', ' ')} velocity" in label
            assert ("no observer" in label) == (law.disturbance_observer is None)
            assert "observer" in label


@pytest.mark.parametrize("row", [Row.LOCAL_PLAIN, Row.LOCAL_EQUAL])
def test_the_paper_s_pd_gains_are_the_feedback_of_the_rows_that_say_so(row: Row) -> None:
    law = SETS[row].parameters
    assert isinstance(law, LocalParameters)
    equal = RegionGains(k_x_per_rad=K_P / law.input_scale_nm, k_v_s_per_rad=K_D / law.input_scale_nm)
    assert "at the paper's PD gains" in row.label and law.regions.low == law.regions.high == equal
    assert row is not Row.LOCAL_PLAIN or {s.gain for s in law.friction.sets} == {PLAIN_L}


def test_the_readings_of_table_1_are_what_their_labels_say() -> None:
    for row, (x, z) in {Row.TABLE1: ("third", "first"), Row.TABLE1_OTHER: ("first", "third")}.items():
        law = SETS[row].parameters
        assert isinstance(law, LocalParameters)
        for region, printed in ((law.regions.low, GAINS_LOW), (law.regions.high, GAINS_HIGH)):
            assert (region.k_x_per_rad, region.k_v_s_per_rad) == (getattr(printed, x), printed.second)
            assert region.k_z_per_rad == getattr(printed, z)
    assert Row.TABLE1.label.endswith("(K_z, K_v, K_x)") and Row.TABLE1_OTHER.label.endswith("(K_x, K_v, K_z)")
    printed_l = SETS[Row.TABLE1_PRINTED_L].parameters
    assert isinstance(printed_l, LocalParameters)
    assert "l_i as printed" in Row.TABLE1_PRINTED_L.label and [s.gain for s in printed_l.friction.sets] == list(L_I)
