"""The whole walk from an unknown axis to a proven controller, in one folder that can be taken up at any time.

axis.py       the axis that the walk is on: virtual and SYNC-stepped, or under a running daemon
state.py      what is done, by hashes of what it was made from
questions.py  what a person must decide
walk.py       the steps in order
steps/        one file for each step
comparison.py laws measured on the axis itself, none twice
runs.py       runs of deployments and comparisons on disk
result.py     the one document that comes out
report.py     the page and its pictures
"""
