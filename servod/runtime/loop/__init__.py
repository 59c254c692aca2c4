"""The loop: the 1 kHz cycle, the process that runs it, and the supervisor's handle on that process.

cycle.py    one cycle, on the data path from frames to torque
channel.py  shared memory between loop and supervisor: records out, commands in
process.py  the loop process: real-time set-up and absolute deadlines
handle.py   the supervisor's side
plan.py     what the supervisor hands to the loop at its start
"""
