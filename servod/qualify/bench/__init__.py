"""The benchmark: how well this machine runs the loop. Every figure is measured, none is extrapolated.

wakeup.py   the loop's wake-up against cyclictest, on the same core, in the same run
tick.py     the work of one cycle without waiting, and of the controller alone
wall.py     daemon and virtual axis as processes on the wall clock: missed periods, deadline to torque, memory
laboratory.py  synthesis, certificate, commissioning
speed.py    SYNC-stepped and simulated time against real time
table.py    the figures as a table and as a file
"""

from servod.qualify.bench.plan import QUICK, THOROUGH, BenchSettings, measure

__all__ = ["QUICK", "THOROUGH", "BenchSettings", "measure"]
