"""The changelog's fragments are what the release's script reads."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import source


@pytest.fixture(scope="module")
def changelog() -> ModuleType:
    spec = importlib.util.spec_from_file_location("changelog", source.ROOT / "scripts/changelog.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_fragments_have_a_kind_and_a_text(changelog: ModuleType) -> None:
    changelog.fragments()
    assert changelog.MARK in changelog.CHANGELOG.read_text()


def test_a_release_lists_its_fragments_by_kind(changelog: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text("how")
    (tmp_path / "slow-scan.fixed.md").write_text("Scan takes\na second.\n")
    (tmp_path / "panel.added.md").write_text("A panel.")
    files = changelog.fragments(tmp_path)
    assert [f.name for f in files] == ["panel.added.md", "slow-scan.fixed.md"]
    text = changelog.section("0.2.0", "2026-12-01", files)
    assert text == "## 0.2.0 (2026-12-01)\n\n### Added\n\n- A panel.\n\n### Fixed\n\n- Scan takes a second.\n"


@pytest.mark.parametrize("name", ["panel.md", "panel.new.md", ".fixed.md", "panel.fixed.txt"])
def test_a_fragment_without_a_kind_is_refused(changelog: ModuleType, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("A panel.")
    with pytest.raises(ValueError, match=r"allowed SLUG\.KIND\.md"):
        changelog.fragments(tmp_path)


def test_an_empty_fragment_is_refused(changelog: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "panel.added.md").write_text("\n")
    with pytest.raises(ValueError, match="allowed a sentence"):
        changelog.fragments(tmp_path)
