"""One-step and window prediction of a recording by an axis model, and what its errors say."""
