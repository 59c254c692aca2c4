"""The fault campaign: scenarios from files are put to a virtual axis, and its drive's own record judges the reaction.

Beside the data path, above everything that runs: a scenario (YAML, `scenarios/`) says what is injected when and what
must happen within how long; an axis under test (`stepped`, `processes`) lets it happen by `actions`; `judge` reads the
drive's record; `variants` finds the scenarios; `run` shows the outcomes. Used by `servoctl qualify faults` and
the tests.
"""
