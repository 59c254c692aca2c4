"""The judgement: held-out error, intervals, location, verdict."""
