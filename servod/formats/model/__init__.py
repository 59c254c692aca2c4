"""The axis model: keys, limits, and the flat form that the kernels read."""
