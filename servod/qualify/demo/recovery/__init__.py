"""`servoctl demo --diagnose`: an axis conceals an effect, is diagnosed from its own recordings, and tracks well again.

walk.py  what can be concealed, and the model that does not know it; design, track, record, diagnose, design again,
         deploy, track; the one report
"""
