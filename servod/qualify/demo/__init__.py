"""The demo: the virtual axis tracks the paper's trajectory (19) under four controllers and a certified set; compared.

axis.py     the demo's axis: configuration, gain sets, plant
entries.py  the rows of the comparison and the options of their laws
certified.py  what a certificate promises, as margins
processes.py  daemon and virtual axis as processes that never outlive the demo
wall.py     the demo on the wall clock, over the control socket like any other client
fast.py     the same runs SYNC-stepped, as fast as they compute
runs.py     one run as arrays, and its score
"""
