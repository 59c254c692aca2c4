"""One suite over every bus and every device driver: parameters come from the driver table, never from a list here."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
