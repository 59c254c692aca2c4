"""The axis model in time: replay of recordings, closed loop, open loop."""
