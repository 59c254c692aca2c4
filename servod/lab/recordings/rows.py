"""Cycle records as rows of a numpy structured array: the same bytes as `servod.formats.recording.record.RECORD`."""

from __future__ import annotations

import numpy as np

from servod.formats.recording.record import FIELDS

#: One cycle record as a row of a structured array.
ROW = np.dtype([(f.name, "<f8" if f.kind == "d" else "<i8") for f in FIELDS])
