"""How long work tells of its progress while it goes on: what it calls, and with what."""

from __future__ import annotations

from collections.abc import Callable

#: What is being done, and the share of the whole that is done, from 0 to 1.
OnProgress = Callable[[str, float], None]
#: The share that is done, from 0 to 1.
OnShare = Callable[[float], None]
#: How many are done, of how many.
OnCount = Callable[[int, int], None]
#: A line of text.
OnLine = Callable[[str], None]
