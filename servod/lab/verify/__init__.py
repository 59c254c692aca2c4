"""Verification of gain sets: what a certificate states, computed without any solver.

Beside the data path, lab extra (numpy, scipy, numba). Never imports servod.lab.synthesize or cvxpy: who checks a design
does not trust the program that made it.
"""
