"""The whole walk from an unknown axis to a proven controller, in one folder that can be taken up at any time.

state.py      what is done, by hashes of what it was made from; the files of a walk
walk.py       the steps in order, and what a person must decide
steps/        one file for each step, the set and its certificate in one
comparison.py laws measured on the axis itself, none twice; their runs on disk
report.py     the one document that comes out, the page and its pictures, and the step that makes them
"""
