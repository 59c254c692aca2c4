"""How well a gain set tracks: trajectory (19), steps of 100 and 10 mrad with a long hold, measured or simulated.

metrics.py    what is measured, from plain arrays
motions.py    the motions, the same for every controller and both worlds
stepped.py    over the whole CAN loop, SYNC-stepped
simulated.py  on the compiled simulator
"""
