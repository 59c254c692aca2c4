"""Recordings as identification, diagnosis and replay see them: canonical columns in SI units, checked and repaired.

`load_recording` reads CSV, CSV.gz, Parquet, MAT v5 and the daemon's MCAP. Off the control path; needs the lab extra.
"""

from __future__ import annotations

from servod.recordings.columns import Quantity, load_column_map
from servod.recordings.recording import Recording, load_recording

__all__ = ["Quantity", "Recording", "load_column_map", "load_recording"]
