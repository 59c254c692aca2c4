"""Fits: numbers with intervals from recordings alone, one file for each experiment. Nothing here moves an axis."""
