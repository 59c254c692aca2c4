"""Identification: experiments on the axis, and fits that work on their recordings alone.

Above session and control socket (`links`), beside nothing that runs in the loop. `experiments` move the axis, `fits`
turn recordings into numbers with 95 % intervals, `walk` does both in order and writes the axis model.
"""
