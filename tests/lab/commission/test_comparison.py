"""The comparison keeps its runs: a law is measured again only when what it depends on has changed."""

from __future__ import annotations

from pathlib import Path

from servod.client.open import VirtualWalkAxis
from servod.formats.gains.gain_set import pd_set
from servod.lab.commission.comparison import measured, run_files
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.state import write_json, write_text
from servod.lab.commission.walk import WalkOptions
from servod.lab.tune.plan import TuningSettings
from servod.lab.tune.tuning import noise_seeds
from servod.qualify.paper.experiments import SCORING_SEED_OFFSET
from tests.lab.commission.test_state import walk
from tests.lab.synthesize.designs import table1


def test_nothing_is_measured_twice(tmp_path: Path) -> None:
    """An axis that refuses the motion as too fast ends a run at once; that is a result as well."""
    suits, file = VirtualWalkAxis(table1(), seed=1).config, tmp_path / "slow.yaml"
    limits = suits.limits.model_copy(update={"speed_rad_s": 0.01})
    axis = VirtualWalkAxis(table1(), seed=1, chosen=suits.model_copy(update={"limits": limits}))
    here = walk(tmp_path, axis, processes=1)

    def again(stiffness: float) -> str:
        write_text(file, pd_set("slow", stiffness, 0.1).to_yaml())
        found = measured(here, axis, {"free_slow": file}, 300.0, lambda _what, _share: None)
        return str(found["free_slow"]["failed"])

    said = again(2.0)
    assert "speed" in said
    figures, _ = run_files(here, "free_slow")
    kept = read_json(figures)
    write_json(figures, kept | {"figures": kept["figures"] | {"failed": "as before"}})
    assert again(2.0) == "as before"
    assert again(2.1) != "as before"
    assert read_json(figures)["inputs_sha256"] != kept["inputs_sha256"]


def test_scoring_tuning_and_identification_share_no_noise() -> None:
    assert (WalkOptions().seed, WalkOptions().scoring_seed, WalkOptions().tuning_seed) == (1, 101, 201)
    for seed in (*range(1200), 10**6, 10**6 + 199):
        options = WalkOptions(seed=seed)
        tuning = TuningSettings(seed=options.tuning_seed)
        ranges = (
            {seed, seed + 1},  # joint and encoder of the virtual axis
            {options.scoring_seed, options.scoring_seed + 1},
            {tuning.seed, *noise_seeds(tuning)},
        )
        assert sum(map(len, ranges)) == len(set.union(*ranges)), seed
    paper = TuningSettings(seed=1)
    assert {1 + SCORING_SEED_OFFSET, 2 + SCORING_SEED_OFFSET}.isdisjoint({1, 2, *noise_seeds(paper)})
