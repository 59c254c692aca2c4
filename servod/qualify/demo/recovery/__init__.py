"""`servoctl demo --diagnose`: an axis conceals an effect, is diagnosed from its own recordings, and tracks well again.

concealed.py  what can be concealed, and the model that does not know it
axes.py       the axis, SYNC-stepped or under a daemon
walk.py       design, track, record, diagnose, design anew, deploy, track
page.py       the one report
"""
