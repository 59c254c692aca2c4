"""Identification: experiments on the axis, and fits that work on their recordings alone.

`experiments` move the axis, `fits` turn recordings into numbers with 95 % intervals, `walk` does both in order and
writes the axis model. Fits and analysis know models and recordings; nothing there could tell a bus from a file.

Experiments have to reach an axis by some way, and it stands here rather than above because what they ask of one (a
motion with torque on top, recorded cycle by cycle, under gains of the moment) is asked by nobody else: `links` states
it as a protocol and has it for the SYNC-stepped virtual axis, which `virtual` makes, `daemon_link` has it for a running
daemon. These three are the only files that know session, control socket or virtual devices; tests/tools holds them to
it. They come last in this package's chain: commands and commissioning make a link and hand it to the walk.
"""
