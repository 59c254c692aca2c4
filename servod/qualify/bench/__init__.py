"""The benchmark: how well this machine runs the loop. Every figure is measured, none is extrapolated.

wakeup.py      the loop's wake-up against cyclictest, on the same core, in the same run
tick.py        the work of one cycle without waiting, and of the controller alone
wall_clock.py  daemon and virtual axis as processes on the wall clock: missed periods, deadline to torque, memory
speed.py       SYNC-stepped and simulated time against real time
attack.py      the loop while clients (attackers.py) do everything wrong
plan.py        all of it in order, with synthesis, certificate and commissioning; targets, table and file
"""

from servod.qualify.bench.plan import QUICK, THOROUGH, BenchSettings, measure

__all__ = ["QUICK", "THOROUGH", "BenchSettings", "measure"]
