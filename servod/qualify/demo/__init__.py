"""The demo: the virtual axis tracks the paper's trajectory (19) under four controllers and a certified set; compared.

axis.py        the demo's axis: configuration, gain sets, plant
entries.py     the rows of the comparison, the options of their laws, and what a certificate promises, as margins
wall_clock.py  the demo on the wall clock, over the control socket like any other client
runs.py        one run as arrays, and its score; all runs SYNC-stepped, as fast as they compute
report.py      the page
recovery/      `demo --diagnose`: concealed physics is found, modelled and compensated
"""
