"""The settings table: a reason beside every number, and every number read by somebody."""

from __future__ import annotations

import ast
from dataclasses import fields
from pathlib import Path

from servod.lab.diagnose import settings

PACKAGE = Path(settings.__file__).parent


def test_every_number_has_its_reason_beside_it() -> None:
    lines = Path(settings.__file__).read_text(encoding="utf-8").splitlines()
    groups = [node for node in ast.parse("\n".join(lines)).body if isinstance(node, ast.ClassDef)]
    bare = [
        f"{group.name}: {lines[row.lineno - 1].strip()}"
        for group in groups
        if group.name != "DiagnosisSettings"
        for row in group.body
        if isinstance(row, ast.AnnAssign) and not lines[row.lineno - 2].startswith("    #: ")
    ]
    assert bare == []


def test_every_number_is_read() -> None:
    readers = [*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "report").rglob("*.py")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in readers if path.name != "settings.py")
    unread = [
        f"{group.name}.{one.name}"
        for group in fields(settings.SETTINGS)
        for one in fields(getattr(settings.SETTINGS, group.name))
        if f"SETTINGS.{group.name}.{one.name}" not in text
    ]
    assert unread == []


def test_no_number_can_be_changed_in_passing() -> None:
    tables = [
        settings.DiagnosisSettings,
        *(type(getattr(settings.SETTINGS, group.name)) for group in fields(settings.SETTINGS)),
    ]
    assert all(table.__dataclass_params__.frozen for table in tables)  # type: ignore[attr-defined]
