"""Fair tuning of all laws: one optimiser, one budget, one set of plants, one limit on roughness, two classes.

plan.py  class, budget and limits of a tuning, and its result
"""
