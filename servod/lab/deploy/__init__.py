"""Deployment with proof: a certified set is tried on the axis, measured against what it replaces and what it promised.

links.py       the axis that it is tried on: SYNC-stepped, or under a running daemon
judge.py       what makes a set stay or go, in numbers
cycles.py      what the cycles of a trial say: motions, limits that were met
outcome.py     how it ended
deployment.py  the trial itself
"""
