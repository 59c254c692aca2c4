"""Deployment with proof: a certified set is tried on the axis, measured against what it replaces and what it promised.

judge.py       what makes a set stay or go, in numbers, and what the cycles of a trial say beside them
outcome.py     how it ended
deployment.py  the trial itself
"""
