"""The axis model in the language of other simulators, and what each language cannot say.

reduce.py       what a format leaves out of a model, one step for each effect
mjcf.py, urdf.py  the reduced model as MJCF (MuJoCo) and as URDF
judge.py        what is lost costs so much; what was written moves in MuJoCo as ours does here
export.py       the room's entry
"""
