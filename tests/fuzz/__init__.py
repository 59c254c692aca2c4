"""Fuzzing: nothing that comes from outside may end in anything but a documented error; `python -m tests.fuzz.run`."""
