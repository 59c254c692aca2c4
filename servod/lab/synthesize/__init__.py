"""Synthesis: local sets, LMIs for both regions, and the gain set that comes out. Needs the lab extra with cvxpy.

Beside the data path, works on files alone. Nothing here is trusted later: servod.lab.verify judges the result again.
"""
