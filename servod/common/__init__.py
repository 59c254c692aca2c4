"""What every part stands on: errors, the table of faults, units, clock, files, YAML, processes."""
