"""One experiment per file: its reason, what it bounds, how it finds its amplitude, and the recordings that it makes."""
