"""Proof of runtime and lab: faults, soak, blind trials, the paper, benchmark, demo."""
