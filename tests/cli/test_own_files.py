"""What stands at `--out` already is refused before any work, and is never lost."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from servod.cli.diagnose import diagnose
from servod.common.errors import BadInput
from servod.common.shipped import shipped
from servod.formats.gains.store import GainStore
from tests.cli.test_output import servoctl
from tests.formats.gains import good

MODEL = shipped("gains/axes/table1_joint.yaml")


@pytest.mark.parametrize(
    ("name", "model", "said"),
    [
        ("model.yaml", "model.yaml", "does not replace"),
        ("model.yaml", None, "model.yaml without diagnosis.json"),
        ("report.html", None, "report.html without diagnosis.json"),
    ],
)
def test_a_diagnosis_replaces_nothing_that_is_not_its_own(
    name: str, model: str | None, said: str, tmp_path: Path
) -> None:
    kept = tmp_path / name
    shutil.copy(MODEL, kept)
    with pytest.raises(BadInput, match=said):
        diagnose([tmp_path / "run.csv"], tmp_path / model if model else MODEL, tmp_path)
    assert kept.read_bytes() == MODEL.read_bytes() and [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "words", [("identify", "--plant", str(MODEL)), ("synthesize", "--model", str(MODEL))], ids=lambda words: words[0]
)
def test_a_folder_is_no_file_and_said_before_the_axis_moves(words: tuple[str, ...], tmp_path: Path) -> None:
    done = servoctl(*words, "--out", str(tmp_path))
    assert done.returncode == 2 and list(tmp_path.parent.glob("*.part")) == [] and list(tmp_path.iterdir()) == []
    assert done.stderr.decode() == f"servoctl: --out {tmp_path}: is a folder, a file is needed\n"


def test_a_set_that_could_never_be_activated_is_not_stored(tmp_path: Path) -> None:
    store = GainStore(tmp_path)
    text = good.certified(good.parse_gains(good.PD, "good.yaml")).to_yaml()
    store.load(text, "good.yaml")
    with pytest.raises(BadInput, match=r"edited\.yaml: seal: found numbers that were changed"):
        store.load(text.replace("position_gain_nm_per_rad: 2.5", "position_gain_nm_per_rad: 2.6"), "edited.yaml")
    assert store.get("bench_pd").version == 1
