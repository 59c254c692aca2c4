"""The reference page of the axis configuration. `python tests/tools/configuration.py` writes it again from the code."""

from __future__ import annotations

from pathlib import Path

import readme
import tables

from servod.cli.config import config_keys

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "configuration.md"
_HEADER = ["Key", "Type", "Unit", "Default", "Range", "Meaning"]


def with_table(text: str) -> str:
    """The page's text with the table as the code has it now."""
    rows = [[f"`{k.key}`", k.type, k.unit, tables.code(k.default), k.range, k.meaning] for k in config_keys()]
    return readme.with_section(text, "config", tables.markdown(_HEADER, rows))


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
