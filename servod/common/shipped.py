"""Where the files that ship with servod stand: gain sets, axis models and systemd units.

Stands on nothing. In a wheel they lie under `servod/share`; in a checkout they are the folders beside the package.
"""

from __future__ import annotations

from pathlib import Path

from servod.common.errors import BadInput

_PACKAGE = Path(__file__).resolve().parents[1]
_ROOTS = (_PACKAGE / "share", _PACKAGE.parent)


def shipped(relative: str) -> Path:
    """The shipped file or folder, e.g. `shipped("gains/demo_pd.yaml")`; raises BadInput when there is none."""
    for root in _ROOTS:
        if (root / relative).exists():
            return root / relative
    raise BadInput(relative, "nothing", f"a file that ships with servod, under {' or '.join(map(str, _ROOTS))}")
