"""The axis model in the language of other simulators, and what each language cannot say.

reduce.py       what a format leaves out of a model, one step for each effect
mjcf.py, urdf.py  the reduced model as MJCF (MuJoCo) and as URDF
export.py       the room's entry: writes a file, says what that loses and costs, and runs it in MuJoCo beside ours
"""
