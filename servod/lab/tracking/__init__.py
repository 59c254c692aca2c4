"""How well a gain set tracks: trajectory (19), steps of 100 and 10 mrad with a long hold, measured or simulated.

metrics.py  the motions, the same for every controller and both worlds; what is measured; on the compiled simulator
stepped.py  over the whole CAN loop, SYNC-stepped
"""
