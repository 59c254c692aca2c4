"""Identification: experiments on the axis, and fits that work on their recordings alone.

`experiments` move the axis, `fits` turn recordings into numbers with 95 % intervals, `walk` does both in order and
writes the axis model. Fits and analysis know models and recordings; nothing there could tell a bus from a file.
Experiments know the axis as any client has it (servod.client.axis), in virtual time or under a daemon.
"""
