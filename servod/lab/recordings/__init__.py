"""Recordings as identification, diagnosis and replay see them: canonical columns in SI units, checked and repaired.

`load_recording` reads tables of text, Parquet, MAT v5, numpy's arrays, JSON, and MCAP of the daemon's and of ROS 2.
Off the control path; needs the lab extra.

A recording may hold 60 million numbers in the columns that are used (20 million rows of three columns, five and a half
hours at 1 kHz) and, as text or MAT file, 1 GiB unpacked; of the daemon's own, which has seven such columns, 8.5
million cycles (2.4 hours) are read from one file. What is larger is refused in one line before it fills the memory.
"""

from __future__ import annotations

from servod.lab.recordings.columns import Quantity, find_map, load_column_map
from servod.lab.recordings.recording import Recording, load_recording

__all__ = ["Quantity", "Recording", "find_map", "load_column_map", "load_recording"]
