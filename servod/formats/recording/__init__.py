"""The daemon's own recording: one record each cycle, MCAP out and in, export."""
